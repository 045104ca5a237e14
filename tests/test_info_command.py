"""`roverflow info` through a pipeline."""

import json
import os
import re
import shlex
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import yaml

from flow.config.templates import SHIPPED
from recordings.ros2.cdr import make
from recordings.ros2.from_msg import read_disparity
from tests.conftest import FRAMES, edit_of, mcap_rows, rewrite, roverflow, write_mcap
from tests.recordings.sample_log import INFOS, LEFT, RIGHT, TILT, changed, dropped, replaced, write_sample
from tests.test_command_line import messages_of


def test_info_describes_a_log(traverse, said):
    output = said(0, "info", traverse).out
    assert "/stereo/left/image_rect_color" in output
    assert f"{FRAMES}" in output
    verdict, command, costs, _ = output.splitlines()[-4:]
    assert verdict == "run -p rover: can run on this log"
    assert command == f"  roverflow run {traverse}"
    assert re.match(rf"  {FRAMES} frames: about \d+ s on .*; result log about \d+ MB, recording about \d+ MB; ", costs)


def test_info_reports_why_a_run_would_refuse_the_log(traverse, said, refused):
    words = (traverse, "-p", "paper", "--set", "source.left=/nix")
    output = said(2, "info", *words).out
    _, _, why = output.partition("run -p paper: would refuse this log: ")
    why = why.splitlines()[0]
    assert why.startswith("the source's 'left' is set to /nix")
    assert output.count(why) == 1
    assert why in refused("run", *words)


CAMERA_TOPICS = ("image_rect", "camera_info")
REFUSED = {
    "names": {"names": ("/a/picture", "/b/picture")},
    "no calibration": {"edits": [dropped(*INFOS)]},
    "no tilt": {"edits": [dropped(TILT)]},
    "no mount": {"edits": [dropped("/tf_static")]},
    "bare numbers": {"edits": [replaced(TILT, lambda message: numbers(message))]},
    "two tilts": {"twice": [TILT]},
    "two pairs": {"twice": [f"/stereo/{side}/{kind}" for side in ("left", "right") for kind in CAMERA_TOPICS]},
    "two calibrations elsewhere": {"moved": ["/stereo/right/camera_info"]},
}


def numbers(message):
    """The accelerations of an Imu alone, as an inclinometer logs them."""
    vector = make("geometry_msgs/msg/Vector3", x=0.1, y=0.2, z=9.8)
    return make("geometry_msgs/msg/Vector3Stamped", header=message.header, vector=vector)


def with_copies(log, out, twice, moved):
    """A log with some topics also below /more, and others only below /one and /two."""
    folders = {**dict.fromkeys(twice, ("", "/more")), **dict.fromkeys(moved, ("/one", "/two"))}
    return write_mcap(out, [(f + topic, *row) for topic, *row in mcap_rows(log) for f in folders.get(topic, [""])])


CAMERA = {
    "camera_model": "pinhole", "intrinsics": [20, 20, 11.5, 7.5], "resolution": [24, 16],
    "distortion_model": "radtan", "distortion_coeffs": [0, 0, 0, 0],
}  # fmt: skip
RIGHT_FROM_LEFT = [[1, 0, 0, -0.25], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
KALIBR = {"cam0": CAMERA, "cam1": {**CAMERA, "T_cn_cnm1": RIGHT_FROM_LEFT}}


@pytest.mark.parametrize("fault", REFUSED)
def test_every_remedy_that_info_lists_leads_to_a_log_that_a_run_accepts(fault, tmp_path, said):
    changes, file = dict(REFUSED[fault]), tmp_path / "calibration.yaml"
    edits, *copies = [changes.pop(kind, []) for kind in ("edits", "twice", "moved")]
    log = with_copies(write_sample(tmp_path / "sample.mcap", *edits, **changes), tmp_path / "log.mcap", *copies)
    file.write_text(json.dumps(KALIBR))  # JSON is YAML
    offered = said(2, "info", log).out.partition("what would supply it:\n")[2].splitlines()
    commands = {line: shlex.split(line.partition("  (")[0].replace("=FILE", f"={file}")) for line in offered}
    refused = [line for line, changes in commands.items() if roverflow("info", log, *changes) != 0]
    untrue = "if /b/picture is the left camera", "right_info=/stereo/left"  # conditions that this log does not meet
    assert len(offered) > len(refused)
    assert refused == [line for line in offered if any(words in line for words in untrue)]


def test_a_pipeline_that_info_writes_names_the_topics_and_the_alternatives(tmp_path, said, refused):
    log, written = write_sample(tmp_path / "log.mcap"), tmp_path / "mine.yaml"
    assert said(0, "info", log, "--write-pipeline", written).out.endswith(f"\nwrote {written}\n")
    source = yaml.safe_load(written.read_text())["source"]
    assert (source["left"], source["right"], source["inclinometer"]) == (LEFT, RIGHT, TILT)
    assert roverflow("info", log, "-p", written) == 0
    assert "exists; choose another name" in refused("info", log, "--write-pipeline", written)
    late = ["-p", written, "--set", "source.time_offset.inclinometer=-150ms"]
    assert roverflow("info", log, *late, "--write-pipeline", tmp_path / "late.yaml") == 0
    assert yaml.safe_load((tmp_path / "late.yaml").read_text())["source"]["time_offset"] == {"inclinometer": "-150 ms"}
    assert roverflow("info", log, "-p", tmp_path / "late.yaml") == 0
    named = write_sample(tmp_path / "named.mcap", names=("/a/picture", "/b/picture"))
    assert roverflow("info", named, "--write-pipeline", tmp_path / "other.yaml") == 2
    assert "  #   left: /a/picture\n  #   right: /b/picture\n" in (tmp_path / "other.yaml").read_text()


def test_a_written_pipeline_is_utf_8_in_any_locale(tmp_path):
    log, own, written = write_sample(tmp_path / "log.mcap"), tmp_path / "own.yaml", tmp_path / "mine.yaml"
    own.write_text(f"# Höhe\n{(SHIPPED / 'fast.yaml').read_text()}", encoding="utf-8")
    command = [sys.executable, "-m", "flow", "info", log, "-p", own, "--write-pipeline", written]
    environment = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    subprocess.run(command, cwd=SHIPPED.parents[1], env=environment, check=True, capture_output=True)
    assert written.read_text(encoding="utf-8").startswith("# Höhe\n")


def test_a_written_pipeline_has_its_source_once_whatever_the_comments_in_it(tmp_path, refused):
    log, own, written = write_sample(tmp_path / "log.mcap"), tmp_path / "own.yaml", tmp_path / "mine.yaml"
    rest = (SHIPPED / "rover.yaml").read_text().split("source: {use: recordings.McapSource}\n")[1]
    own.write_text(f"source:\n  use: recordings.McapSource\n# the left one\n  left: {LEFT}\n\n# of rover\n{rest}")
    assert roverflow("info", log, "-p", own, "--write-pipeline", written) == 0
    text = written.read_text()
    assert text.count("  left: ") == 1
    assert text.endswith(f"\n\n# of rover\n{rest}")
    assert roverflow("info", log, "-p", written) == 0
    own.write_text(json.dumps(yaml.safe_load(own.read_text())))
    sentence = refused("info", log, "-p", own, "--write-pipeline", tmp_path / "other.yaml")
    assert "has no 'source:' at the beginning of a line" in sentence


def test_info_compares_the_search_range_with_the_ground_in_view(traverse, said):
    found = json.loads(said(0, "info", traverse, "--json").out)["search_range"]
    truth = max(float(np.nanmax(read_disparity(each))) for each in messages_of(traverse, "/truth/disparity"))
    assert 0.9 * found["ground_px"] < truth < found["range_px"]
    enough = f"--set disparities={found['range_px']:.0f}"
    assert f"{enough} includes it" in said(0, "info", traverse, "--set", "disparities=16").out
    assert f"fewer than 192 disparities: {enough} runs faster" in said(0, "info", traverse).out


def test_info_names_the_search_range_as_the_pipeline_has_it(traverse, tmp_path, said):
    mine = tmp_path / "mine.yaml"
    pair = "streams:\n  stereo: {use: flow.align.pair, left: left, right: right}"
    for use in (
        "{template: rover_disparity, frame: stereo, disparities: 400}",
        "{template: rover_disparity, frame: stereo}",
        "{use: stages.Match, frame: stereo, disparities: 400}",
    ):
        parts = (
            "source: {use: recordings.McapSource}",
            pair,
            f"  disparity: {use}",
            "sinks: [{use: recordings.McapSink}]",
        )
        mine.write_text("\n".join(parts))
        (line,) = (line for line in said(0, "info", traverse, "-p", mine).out.splitlines() if "runs faster" in line)
        change = line.split("--set ")[1].split()[0]
        assert change.startswith("disparity.disparities=")
        assert "runs faster" not in said(0, "info", traverse, "-p", mine, "--set", change).out


@pytest.mark.parametrize("times", [1, 10, 1000])  # 1000: written in mm
def test_info_doubts_a_baseline_for_which_no_search_range_is_enough(traverse, tmp_path, said, times):
    def longer(index: int, message: Any) -> None:
        message.p = message.p * np.where(np.arange(12) == 3, times, 1.0)

    log = rewrite(traverse, tmp_path / "log.mcap", edit_of("right/camera_info", "sensor_msgs/msg/CameraInfo", longer))
    found = json.loads(said(0, "info", log, "--json").out)["search_range"]
    output = said(0, "info", log).out
    assert found["range_px"] <= 1024
    assert bool(found["doubt"]) == (times > 1)
    doubt = f"ends at 320 px: the baseline of {0.24 * times:g} m, or the height of 0.90 m, looks wrong"
    assert (doubt in output) == (times > 1)
    assert ("--set disparities" in output) == (times == 1)


def test_info_recognises_a_result_and_its_pipeline(result, said):
    output = said(0, "info", result).out
    assert re.search(r"\nThis is a result of roverflow \S+: pipeline rover, run on traverse\.mcap\.\n", output)
    assert "missing" not in output
    assert output.endswith("would refuse this log: it contains results; run the log that they were made from\n")


def test_info_of_a_cut_log_ends_incomplete(traverse, tmp_path, said):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(traverse.read_bytes()[: traverse.stat().st_size * 2 // 3])
    assert "damaged" in said(3, "info", cut).out


def test_info_uses_the_settings_of_the_pipeline(traverse, tmp_path, said):
    def streams(*given, code=0):
        return json.loads(said(code, "info", traverse, "--json", *given).out)["streams"]

    pipeline = tmp_path / "tf.yaml"
    text = (SHIPPED / "rover.yaml").read_text()
    pipeline.write_text(text.replace("{use: recordings.McapSource}", "{use: recordings.McapSource, odometry: /nix}"))
    assert streams()["odometry"] == "/odometry"
    assert streams("-p", pipeline, "--set", "source.odometry=/odometry") == streams()
    assert "odometry" not in streams("-p", pipeline, code=2)


def test_pairs_in_a_gap_of_the_poses_are_damage(tmp_path, said):
    log = write_sample(tmp_path / "log.mcap", dropped("/odom", numbers=[1, 2, 3]))
    output = said(3, "info", log, "--set", "logged.max_gap=350ms").out
    assert "; 2 stereo pairs with a pose; " in output
    assert (
        "\ndamaged: 3 of 5 stereo pairs in a gap of the poses, over 0.35 s long; a run loses the pose there\n" in output
    )
    assert "; 5 stereo pairs with a pose; " in said(0, "info", log).out
    early = write_sample(tmp_path / "early.mcap", dropped("/odom", numbers=[0, 1]))
    assert "; 3 stereo pairs with a pose; " in said(0, "info", early).out  # before the first pose is no gap


def test_info_counts_pairs_and_tilts_by_the_pipeline(tmp_path, said):
    edit = changed((RIGHT, TILT), {"header.stamp.nanosec": lambda time: time + 8_000_000})
    log, pipeline = write_sample(tmp_path / "log.mcap", edit), tmp_path / "named.yaml"

    def frames(*given):
        found = json.loads(said(0, "info", log, "--json", *given).out)["frames"]
        return found["pairs"], found["slop_s"], found["with_tilt"], found["tilt_gap_s"]

    assert frames() == (0, 0.005, 4, 0.2)
    assert frames("--set", "stereo.slop=10 ms") == (5, 0.01, 4, 0.2)
    assert frames("--set", "tilt.max_gap=1 ms", "--set", "logged.max_gap=2 s") == (0, 0.005, 0, 0.001)
    for wide, output in (("5 ms", "left image has a right image"), ("10 ms", "frame has tilt readings")):
        words = ("--set", f"stereo.slop={wide}", "--set", "tilt.max_gap=1 ms")
        last = said(0, "info", log, *words).out.splitlines()[-1]
        assert last == f"run -p rover: can run on this log, but no {output} near enough in time (see frames)"
    pipeline.write_text("""
source: {use: recordings.McapSource}
streams:
  eyes:    {use: flow.align.pair, left: left, right: right, slop: 9 ms}
  up:      {use: flow.align.interpolate, stream: inclinometer, at: eyes, max_gap: 50 ms}
  resting: {use: flow.align.interpolate, stream: odometry, at: eyes, max_gap: 3 s}
  half:    {use: stages.Rectify, frame: eyes}
sinks: [{use: recordings.McapSink}]
""")
    assert frames("-p", pipeline) == (5, 0.009, 0, 0.05)
    pipeline.write_text(pipeline.read_text().replace("stream: inclinometer", "stream: odometry"))
    assert frames("-p", pipeline) == (5, 0.009, None, None)


def test_info_refuses_a_source_of_another_kind(traverse, tmp_path, refused):
    pipeline = tmp_path / "toys.yaml"
    pipeline.write_text("""
source: {use: tests.flow.toys.Source}
streams:
  both:  {use: flow.align.pair, left: left, right: right}
  twice: {use: tests.flow.toys.Scale, couple: both}
sinks: [{use: tests.flow.toys.Keep}]
""")
    assert "tests.flow.toys.Source is not recordings.McapSource" in refused("info", traverse, "-p", pipeline)
