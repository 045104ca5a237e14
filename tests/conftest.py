"""Fixtures of several test files: a short simulated traverse, and logs cut out of it."""

import fcntl
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from mcap.reader import make_reader
from mcap.writer import Writer

from flow.cli.main import main
from recordings.mcap.writer import Ros2Writer
from recordings.ros2.cdr import standard_types

settings.register_profile("quick", deadline=None, max_examples=20)  # the first example may compile a kernel
settings.register_profile("thorough", deadline=None, max_examples=100)
settings.load_profile("quick")

FRAMES = 3
TRAVERSE = {"frames": FRAMES, "width": 320, "height": 240, "relief_cells": 512}  # of Simulation
SMALL = ("--set", "disparities=64")
Row = tuple[str, str, tuple[str, str, bytes] | None, int, bytes | None]  # topic, encoding, schema, log time, data
Extra = Callable[[Writer, dict[str, int]], object]  # writes more to a log; takes topic -> channel


@pytest.fixture(scope="session")
def traverse(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated log of a few small frames, with ground truth."""
    return _simulated(tmp_path_factory)


@pytest.fixture(scope="session")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The traverse, run through the default pipeline; its recording and its summary are beside it."""
    return _run(tmp_path_factory)


@pytest.fixture(scope="session")
def fast_result(traverse: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The traverse, run through the fastest pipeline."""
    return made_once(tmp_path_factory, "fast/out.mcap", lambda out: run_fast(out, traverse))


@pytest.fixture(scope="session", autouse=True)
def kernels(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Of several processes of pytest, one compiles the kernels of the default pipeline, and the others wait for it."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        _run(tmp_path_factory)  # no fixture, because files have fixtures of the same name


def _simulated(factory: pytest.TempPathFactory) -> Path:
    from recordings.simulator import Simulation, write_log

    simulation = Simulation(**TRAVERSE)
    return made_once(factory, "traverse/traverse.mcap", lambda path: write_log(simulation, path))


def _run(factory: pytest.TempPathFactory) -> Path:
    def run(out: Path) -> None:
        words = (*SMALL, "-o", out, "--summary", out.with_suffix(".json"))
        assert roverflow("run", _simulated(factory), *words) == 0

    return made_once(factory, "result/out.mcap", run)


def made_once(factory: pytest.TempPathFactory, place: str, make: Callable[[Path], object]) -> Path:
    """The file that `make` writes, with those beside it, in a folder of this process's own. place: folder/file.

    Of several processes of pytest, one makes the files, and the others copy them.
    """
    folder, name = place.split("/")
    shared = factory.getbasetemp().parent if "PYTEST_XDIST_WORKER" in os.environ else factory.getbasetemp()
    made = shared / f"{folder}-made"
    with shared.joinpath(f"{folder}-lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (made / name).exists():
            made.mkdir(exist_ok=True)
            make(made / name)
    return shutil.copytree(made, factory.mktemp(folder) / folder) / name


def slow(*cases: Any) -> list[Any]:
    """Cases of a test that only `make check-all` runs."""
    several = (case if isinstance(case, tuple) else (case,) for case in cases)
    return [pytest.param(*values, marks=pytest.mark.slow) for values in several]


def data_folder(name: str) -> Path:
    """A folder of the real data, or a skip with its name."""
    folder = Path(os.environ.get("ROVERFLOW_DATA", "")) / name
    if "ROVERFLOW_DATA" not in os.environ or not folder.exists():
        pytest.skip(f"needs the real data: set ROVERFLOW_DATA to the folder with {name}")
    return folder


def roverflow(*arguments: object) -> int:
    """What the command line makes of these arguments."""
    return main([str(argument) for argument in arguments])


def run_fast(out: Path, log: Path | Sequence[Path], *options: object, code: int = 0) -> Path:
    """The result of a run of the fastest pipeline, without a recording."""
    logs = [log] if isinstance(log, Path) else log
    assert roverflow("run", *logs, "-p", "fast", *SMALL, "-o", out, "--no-rrd", *options) == code
    return out


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    """What a command prints, `.out` and `.err`: said(exit code, its words)."""

    def command(code: int, *words: object) -> Any:
        capsys.readouterr()
        assert roverflow(*words) == code, words
        return capsys.readouterr()

    return command


@pytest.fixture
def refused(said: Callable[..., Any]) -> Callable[..., str]:
    """The one sentence by which a command refuses its words."""

    def command(*words: object) -> str:
        sentence: str = said(2, *words).err
        assert sentence.count("\n") == 1, sentence
        return sentence

    return command


def mcap_rows(log: Path) -> list[Row]:
    """The messages of a log in the order of log time."""
    with log.open("rb") as file:
        return [
            (channel.topic, channel.message_encoding, (schema.name, schema.encoding, schema.data), at.log_time, at.data)
            for schema, channel, at in make_reader(file).iter_messages()
            if schema
        ]


def chunks_of(log: Path) -> list[tuple[Any, set[str]]]:
    """Each chunk in the index of a log, with the topics in it."""
    with log.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    topics = {number: channel.topic for number, channel in summary.channels.items()}
    return [(chunk, {topics[number] for number in chunk.message_index_offsets}) for chunk in summary.chunk_indexes]


def with_broken(log: Path, *chunks: Any) -> Path:
    """The log beside it with broken chunks."""
    content = bytearray(log.read_bytes())
    for chunk in chunks:
        content[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 0xFF
    (damaged := log.with_name("damaged.mcap")).write_bytes(content)
    return damaged


def patch(path: Path, place: int, data: bytes) -> None:
    """Replace the bytes at a place of a file."""
    with path.open("r+b") as file:
        file.seek(place)
        file.write(data)


def write_mcap(
    out: Path,
    rows: Iterable[Row],
    profile: str = "ros2",
    extra: Extra = lambda writer, channels: None,
    **options: Any,
) -> Path:
    """Write a log; a row without data gives its topic a channel alone.

    extra: is called at the end; options: of mcap.writer.Writer.
    """
    with out.open("wb") as file:
        writer, channels = Writer(file, **options), dict[Any, int]()
        writer.start(profile=profile, library="test")
        for topic, encoding, schema, log_time, data in rows:
            key = topic, encoding, schema
            if key not in channels:
                known = writer.register_schema(*schema) if schema else 0
                channels[key] = writer.register_channel(topic, encoding, known)
            if data is not None:
                writer.add_message(channels[key], log_time, data, log_time)
        extra(writer, {topic: number for (topic, *_), number in channels.items()})
        writer.finish()
    return out


def write_messages(out: Path, rows: Iterable[tuple[int, str, Any]]) -> Path:
    """Write a log of messages, each (log time, topic, message), in the order of log time."""
    with Ros2Writer(out) as writer:
        for log_time, topic, message in sorted(rows, key=itemgetter(0)):
            writer.write(topic, message, log_time)
    return out


def rewrite(
    source: Path,
    out: Path,
    change: Callable[[str, int, bytes], bytes | None] = lambda topic, index, data: data,
    *,
    time: Callable[[str, int], int] = lambda topic, log_time: log_time,
    order: Callable[[list[Row]], list[Row]] = list,
    encode: Callable[[str, int, bytes], tuple[str, bytes]] | None = None,
    silent: bool = False,
    **options: Any,
) -> Path:
    """Copy a log message by message, as another kind of MCAP file; options: of `write_mcap`.

    change: (topic, index in topic, data) -> the data to write, None to drop it; time: (topic, log time) -> log time;
    order: changes which message follows which; encode: (topic, index, schema) -> another message encoding and
    schema; silent: whether a topic without messages keeps its channel.
    """
    counts = Counter[str]()

    def rows() -> Iterator[Row]:
        for topic, encoding, (name, form, text), log_time, data in order(mcap_rows(source)):
            index = counts[topic]
            counts[topic] += 1
            changed = change(topic, index, data)
            if encode:
                encoding, text = encode(topic, index, text)
            if silent or changed is not None:
                yield topic, encoding, (name, form, text), time(topic, log_time), changed

    return write_mcap(out, rows(), **options)


def halves(log: Path, folder: Path) -> list[Path]:
    """The log as the two files of a recording in a folder."""
    rows = mcap_rows(log)
    parts = rows[: len(rows) // 2], rows[len(rows) // 2 :]
    return [write_mcap(folder / f"bag_{number}.mcap", part) for number, part in enumerate(parts)]


def edit_of(topic: str, schema: str, edit: Callable[[int, Any], object]) -> Callable[[str, int, bytes], bytes]:
    """A change for `rewrite`: `edit(index, message)` changes the decoded messages of topics that end so."""

    def change(name: str, index: int, data: bytes) -> bytes:
        if not name.endswith(topic):
            return data
        message = standard_types().deserialize_cdr(data, schema)
        edit(index, message)
        return bytes(standard_types().serialize_cdr(message, schema))

    return change


def an_hour_later(source: Path, out: Path) -> Path:
    """Copy a log with images whose header stamps are an hour later."""

    def later(index: int, image: Any) -> None:
        image.header.stamp.sec += 3600

    return rewrite(source, out, edit_of("/image_rect_color", "sensor_msgs/msg/Image", later))
