"""`roverflow verify`: a result log is as its run wrote it, and the same run gives it again."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader

from flow.cli import replay
from flow.cli.debugging import verify
from recordings.mcap.file import iter_decoded
from recordings.mcap.writer import MessageKind, Ros2Writer
from tests.conftest import chunks_of, edit_of, mcap_rows, rewrite, roverflow, run_fast, with_broken

TOPICS = "13 topics"
OWN = """
from dataclasses import dataclass
from stages import StereoFrame


@dataclass(frozen=True)
class Sharpness:
    def __call__(self, frame: StereoFrame) -> float:
        return float(frame.left.std())
"""


@pytest.fixture(scope="module")
def short(traverse, tmp_path_factory):
    """Makes a result of the first frames of the traverse, beside a copy of it."""
    log = Path(shutil.copy(traverse, tmp_path_factory.mktemp("verify")))

    def make(name, *words):
        return run_fast(log.with_name(name), log, "--end", "1.2", *words)

    return make


def edited(result, out, change=lambda topic, data: data, more="", **facts):
    """A result log with other messages, one more on a topic, or with other facts of the end of its run."""
    with result.open("rb") as file:
        records = {record.name: dict(record.metadata) for record in make_reader(file).iter_metadata()}
    records["roverflow.run"] |= facts
    with Ros2Writer(out) as writer:
        writer.metadata("roverflow", records.pop("roverflow"))
        for topic, encoding, schema, stamp, data in mcap_rows(result):
            kind = MessageKind(schema[0], encoding, *schema[1:])
            writer.add(topic, kind, stamp, change(topic, data))
            if topic == more:
                writer.add(topic, kind, stamp, data, copy_of=7)  # in a channel of its own
                more = ""
        for name, values in records.items():
            writer.metadata(name, values)
    return out


def test_the_same_run_again_gives_the_same_messages(result, traverse, said):
    """Also without the recording that the first run wrote."""
    lines = said(0, "verify", result, "--log", traverse, "--workers", 1).out.splitlines()
    assert lines == [f"{TOPICS} as the run wrote them", f"{TOPICS} the same in a second run of {traverse.name}"]


@pytest.mark.parametrize("words", [
    ["--with-inputs", "--every", "2"],
    ["--profile", "foxglove", "--start", "0.4", "--every", "0.3m", "--set", "McapSink.point_spacing=0"],
])  # fmt: skip
def test_a_second_run_has_the_options_of_the_first(short, said, words):
    assert said(0, "verify", short("options.mcap", *words)).out.count("topics") == 2


def test_a_changed_message_is_found(short, said, tmp_path):
    result = short("changed.mcap")
    other = edited(result, tmp_path / "out.mcap", lambda topic, data: data[:-1] + b"?" if "points" in topic else data)
    first, *_, last = said(3, "verify", other, "--log", result.with_name("traverse.mcap")).out.splitlines()
    assert first == "changed since its run: /nav/points"
    assert last == f"{TOPICS} the same in a second run of traverse.mcap"


def test_an_added_message_is_found_and_stays_found_without_the_input(short, said, tmp_path):
    result = short("added.mcap")
    other = edited(result, tmp_path / "out.mcap", more="/nav/points")
    assert said(3, "verify", other, "--log", result.with_name("traverse.mcap")).out.startswith(
        "changed since its run: /nav/points\n"
    )
    first, second = said(3, "verify", other).out.splitlines()
    assert first == "changed since its run: /nav/points"
    assert second.startswith("not run again: the input of ")


def test_an_interrupted_second_run_is_not_compared(short, said, monkeypatch):
    def interrupted(*given, **options):
        return replay.replay(*given, **options) | {"interrupted": True}

    result = short("calm.mcap")
    monkeypatch.setattr(verify, "replay", interrupted)
    assert said(130, "verify", result).out.splitlines()[-1] == "interrupted: the second run was not compared"


def test_a_stage_beside_the_result_is_found(traverse, tmp_path, monkeypatch, said):
    (tmp_path / "own_stages.py").write_text(OWN)
    log, mine = Path(shutil.copy(traverse, tmp_path)), tmp_path / "mine.yaml"
    mine.write_text(
        "source: {use: recordings.McapSource}\nstreams:\n"
        "  stereo: {use: flow.align.pair, left: left, right: right}\n"
        "  sharpness: {use: own_stages.Sharpness, frame: stereo}\n"
        "sinks: [{use: recordings.McapSink, also: [sharpness]}]\n"
    )
    assert roverflow("run", log, "-p", mine, "-o", tmp_path / "own.mcap", "--no-rrd") == 0
    monkeypatch.setattr("sys.path", [path for path in sys.path if path != str(tmp_path)])
    monkeypatch.delitem(sys.modules, "own_stages")
    assert said(0, "verify", tmp_path / "own.mcap").out.count("2 topics") == 2


def test_another_input_gives_other_results_and_the_versions_are_named(short, traverse, said, tmp_path, monkeypatch):
    def darken(index, message):
        message.data = np.asarray(message.data) // 2

    result = short("out.mcap")
    other = rewrite(traverse, tmp_path / "dark.mcap", edit_of("left/image_rect_color", "sensor_msgs/msg/Image", darken))
    monkeypatch.setattr(replay, "version", lambda name: "0.0.0")
    again = tmp_path / "again.mcap"
    words = ("verify", result, "--log", other)
    whole, note, different, versions, remedy = said(3, *words, "-o", again).out.splitlines()
    assert whole == f"{TOPICS} as the run wrote them"
    assert note == f"note: {other} has other bytes than the input of {result}; only up to three stamps were compared"
    assert different.startswith("different in a second run of dark.mcap, which may be another log: /nav/")
    assert "/nav/disparity, " in different
    assert versions.startswith("since its run: ")
    assert f"numpy {np.__version__}, now 0.0.0" in versions
    assert remedy == f"roverflow diff {result} {again}"
    said(3, "diff", result, again)
    assert said(3, *words).out.endswith("-o AGAIN.mcap keeps the second result\n")


def test_a_calibration_that_changed_since_is_named(traverse, tmp_path, said):
    log, info = tmp_path / "log.mcap", tmp_path / "right.yaml"
    shutil.copy(traverse, log)
    files = calibrations_of(traverse, tmp_path)
    change = f"--set=source.calibration=[{','.join(map(str, files))}]"
    out = run_fast(tmp_path / "out.mcap", log, change, "--end", "1.2")
    assert "the same in a second run" in said(0, "verify", out).out
    content = yaml.safe_load(info.read_text())
    content["projection_matrix"]["data"][3] *= 1.2
    info.write_text(yaml.safe_dump(content))
    lines = said(3, "verify", out).out.splitlines()
    assert f"since its run: {info} has other content" in lines


def calibrations_of(log, folder):
    """Files of ROS of the two cameras."""
    files = []
    for side in ("left", "right"):
        _, _, info = next(iter_decoded(log, [f"/stereo/{side}/camera_info"]))
        matrices = {"camera_matrix": (3, 3, info.k), "distortion_coefficients": (1, len(info.d), info.d),
                    "rectification_matrix": (3, 3, info.r), "projection_matrix": (3, 4, info.p)}  # fmt: skip
        content = {"image_width": info.width, "image_height": info.height, "camera_name": side,
                   "distortion_model": info.distortion_model}  # fmt: skip
        content |= {name: {"rows": r, "cols": c, "data": list(map(float, m))} for name, (r, c, m) in matrices.items()}
        files.append(folder / f"{side}.yaml")
        files[-1].write_text(yaml.safe_dump(content, sort_keys=False))
    return files


def test_what_cannot_be_verified_is_refused_in_a_sentence(short, traverse, refused, tmp_path):
    result = short("out.mcap")
    assert "is not a result log" in refused("verify", traverse)
    alone = shutil.copy(result, tmp_path / "alone.mcap")
    assert "traverse.mcap, is not in its folder; give it with --log" in refused("verify", alone)
    stopped = edited(result, tmp_path / "stopped.mcap", interrupted="True")
    assert "was interrupted, so it cannot be repeated; only the file was checked" in refused("verify", stopped)
    hurried = edited(result, tmp_path / "hurried.mcap", **{"drops.dropped": "2"})
    assert "dropped frames, so it cannot be repeated" in refused("verify", hurried)
    broken = with_broken(result, chunks_of(result)[0][0])
    assert "is damaged: " in refused("verify", broken)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(result.read_bytes()[:-2000])
    assert "has no digests of its topics, because its end is missing" in refused("verify", cut)
    assert "is an input of this command" in refused("verify", result, "-o", result)
