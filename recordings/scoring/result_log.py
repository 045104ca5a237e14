"""What a result log contains about its run: the part of the input log, and why a result is missing."""

from __future__ import annotations

import os
import struct
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Metadata
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray

from flow.contracts import as_text
from recordings.containers.digest import log_digest
from recordings.containers.finding import find_files
from recordings.containers.opening import open_recording
from recordings.errors import LogError
from recordings.mcap.file import McapFile

_UNREADABLE = (McapError, OSError, ValueError, struct.error, MemoryError, OverflowError)


def about_run(result: Path) -> dict[str, str]:
    """The facts of the run that wrote a result log; empty for another log."""
    if not result.is_file():  # a pipe would never open
        return {}
    with suppress(*_UNREADABLE), result.open("rb") as file:
        *_, record = islice(StreamReader(file, emit_chunks=True).records, 2)  # the header and the first metadata record
        if isinstance(record, Metadata) and record.name == "roverflow":
            return dict(record.metadata)
    return {}


def facts_of(result: Path, remedy: str) -> dict[str, str]:
    """The facts of the run that wrote a result log; raises LogError for another log, with what to give instead."""
    about = about_run(result)
    if not about:
        open_recording(result).close()  # a file that cannot be read is refused for that
        raise LogError(f"{result} is not a result log; give {remedy}")
    return about


def check_profile(path: Path, about: Mapping[str, str]) -> None:
    """Raise LogError for a result log whose messages are not those of ROS 2. about: its facts by `about_run`."""
    if about.get("profile", "ros2") != "ros2":
        raise LogError(f"{path} has results in Foxglove's messages; run the log again with --profile ros2")


def end_of_run(result: Path, record: str = "roverflow.run") -> dict[str, str]:
    """The pipeline, the verdict, counts and findings of a run; empty if the end of its result log is missing.

    record: the metadata record of that end; that of the topics' digests is "roverflow.digests".
    """
    with suppress(Exception), result.open("rb") as file:  # a cut log fails mcap's reader in any way
        for found in make_reader(file).iter_metadata():
            if found.name == record:
                return dict(found.metadata)
    return {}


def pipeline_of(result: Path) -> str:
    """The name of the pipeline that wrote a complete result log."""
    return end_of_run(result).get("pipeline", "unknown")


def input_beside(result: Path) -> list[Path]:
    """The input of a run where it would be beside the result log: the file, the files or the folder."""
    named = about_run(result).get("log") or result.name
    known = {as_text(file.name): file for file in result.parent.glob("*")}
    beside = [[known.get(name, result.with_name(name)) for name in names] for names in ([named], named.split(", "))]
    return next((files for files in beside if all(file.exists() for file in files)), beside[0])


def names_of(logs: Sequence[Path]) -> str:
    """The name of a log of one or several files, as the facts of a run contain it; that of a folder also for "."."""
    names = (Path(os.path.abspath(path)).name for path in dict.fromkeys(logs))  # noqa: PTH100  # keeps links
    return as_text(", ".join(names))


def is_input(about: Mapping[str, str], logs: Sequence[Path]) -> bool:
    """Whether a log, its files in any order or its folder, has the bytes of the input of a run. about: its facts."""
    files, order = find_files(logs).files, {name: at for at, name in enumerate(about.get("log", "").split(", "))}
    in_order = sorted(files, key=lambda file: order.get(as_text(file.name), len(order)))
    return about.get("log_digest") in {log_digest(files), log_digest(in_order)}


def part_run(result: Path, logs: Sequence[Path]) -> tuple[float | None, float | None]:
    """Start and end of the run in its input, s after the first message; None for no limit or if unknown.

    logs: the files of the input, or its folder.
    """
    about = about_run(result)
    if about.get("log") != names_of(logs) and not is_input(about, logs):
        return None, None
    start, end = (float(about[name]) if about.get(name) else None for name in ("start", "end"))
    return start, end


def span_run(result: Path, logs: Sequence[Path]) -> tuple[int, int] | None:
    """The first and the last stamp, ns, of the results of a run of a part of its input, where `part_run` does not know
    this input; else None. logs: as there."""
    about = about_run(result)
    if not (about.get("start") or about.get("end")) or part_run(result, logs) != (None, None):
        return None
    stamps = stamps_of(result)
    return (int(stamps[0]), int(stamps[-1])) if stamps.size else None


def stamps_of(result: Path, results: bool = False) -> NDArray[np.int64]:
    """The sorted stamps, ns, of the diagnostics in a result log, which each frame and each loss have.

    results: those of frames with a result instead, each once.
    """
    with McapFile(result) as log:
        if not results:
            return log.times(log.channels_of(["/nav/diagnostics"]))
        topics = {channel.topic for channel in log.channels.values() if channel.topic.startswith("/nav/")}
        return np.unique(log.times(log.channels_of(topics - {"/nav/diagnostics"})))


def stamps_run(result: Path) -> set[int] | None:
    """The stamps of the frames that a run of selected frames (`run --every`) took; None for a run of all frames."""
    if not about_run(result).get("every"):
        return None
    return set(stamps_of(result).tolist())


def without_results(path: Path, wanted: Sequence[str], instead: Sequence[str] = (), remedy: str = "") -> LogError:
    """The error for a log without any of the result topics `wanted`; with the `remedy` if it has one of `instead`."""
    check_profile(path, about_run(path))
    with McapFile(path) as log:
        topics = sorted({log.channels[n].topic for n in log.channels if log.count({n})})
    results = [topic for topic in topics if topic.startswith("/nav/")]
    if not results:
        return LogError(f"{path} is not a result log: it has no /nav topics; give the log that roverflow run wrote")
    lacking = f"no {wanted[0]}" if len(wanted) == 1 else f"none of {', '.join(wanted)}"
    why = "the run produced none, or the 'results' of its McapSink do not name it"
    more = f"; {remedy}" if set(instead) & set(results) else ""
    return LogError(f"{path} contains {lacking}, only {', '.join(results)}: {why}{more}")
