"""`roverflow info` through a pipeline."""

import json
import re

from flow.config.loader import SHIPPED
from tests.conftest import FRAMES, roverflow
from tests.recordings.sample_log import RIGHT, TILT, write_sample


def test_info_describes_a_log(traverse, capsys):
    assert roverflow("info", traverse) == 0
    output = capsys.readouterr().out
    assert "/stereo/left/image_rect_color" in output
    assert f"{FRAMES}" in output
    assert output.splitlines()[-1] == "run -p rover: can run on this log"


def test_info_reports_why_a_run_would_refuse_the_log(traverse, capsys):
    assert roverflow("info", traverse, "-p", "paper", "--set", "source.left=/nix") == 0
    output = capsys.readouterr().out.splitlines()[-1]
    assert output.startswith("run -p paper: would refuse this log: the source's 'left' is set to /nix")
    assert roverflow("run", traverse, "-p", "paper", "--set", "source.left=/nix") == 2
    assert output.partition("refused: ")[2] in capsys.readouterr().err


def test_info_recognises_a_result_and_its_pipeline(result, capsys):
    assert roverflow("info", result) == 0
    output = capsys.readouterr().out
    assert re.search(r"\nThis is a result of roverflow \S+: pipeline rover, run on traverse\.mcap\.\n", output)
    assert "missing" not in output
    assert output.endswith("would refuse this log: it contains results; run the log that they were made from\n")


def test_info_of_a_cut_log_ends_incomplete(traverse, tmp_path, capsys):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(traverse.read_bytes()[: traverse.stat().st_size * 2 // 3])
    assert roverflow("info", cut) == 3
    assert "damaged" in capsys.readouterr().out


def test_info_uses_the_settings_of_the_pipeline(traverse, tmp_path, capsys):
    def streams(*given):
        assert roverflow("info", traverse, "--json", *given) == 0
        return json.loads(capsys.readouterr().out)["streams"]

    pipeline = tmp_path / "tf.yaml"
    text = (SHIPPED / "rover.yaml").read_text()
    pipeline.write_text(text.replace("{use: recordings.McapSource}", "{use: recordings.McapSource, odometry: /nix}"))
    assert streams()["odometry"] == "/odometry"
    assert streams("-p", pipeline, "--set", "source.odometry=/odometry") == streams()
    assert "odometry" not in streams("-p", pipeline)


def test_info_counts_pairs_and_tilts_by_the_pipeline(tmp_path, capsys):
    def edit(topic, number, message):
        if topic in (RIGHT, TILT):
            message.header.stamp.nanosec += 8_000_000
        return message

    log, pipeline = write_sample(tmp_path / "log.mcap", edit), tmp_path / "named.yaml"

    def frames(*given):
        assert roverflow("info", log, "--json", *given) == 0
        found = json.loads(capsys.readouterr().out)["frames"]
        return found["pairs"], found["slop_s"], found["with_tilt"], found["tilt_gap_s"]

    assert frames() == (0, 0.005, 4, 0.2)
    assert frames("--set", "stereo.slop=10 ms") == (5, 0.01, 4, 0.2)
    assert frames("--set", "tilt.max_gap=1 ms", "--set", "logged.max_gap=2 s") == (0, 0.005, 0, 0.001)
    for wide, output in (("5 ms", "left image has a right image"), ("10 ms", "frame has tilt readings")):
        assert roverflow("info", log, "--set", f"stereo.slop={wide}", "--set", "tilt.max_gap=1 ms") == 0
        last = capsys.readouterr().out.splitlines()[-1]
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


def test_info_refuses_a_source_of_another_kind(traverse, tmp_path, capsys):
    pipeline = tmp_path / "toys.yaml"
    text = """
source: {use: tests.flow.toys.Source}
streams:
  both:  {use: flow.align.pair, left: left, right: right}
  twice: {use: tests.flow.toys.Scale, couple: both}
sinks: [{use: tests.flow.toys.Keep}]
"""
    pipeline.write_text(text)
    assert roverflow("info", traverse, "-p", pipeline) == 2
    assert "tests.flow.toys.Source is not recordings.McapSource" in capsys.readouterr().err
