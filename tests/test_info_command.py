"""What `roverflow info` says of a log, and through which pipeline it looks at it."""

from __future__ import annotations

import json

from flow.cli import main
from flow.pipeline import SHIPPED
from tests.conftest import FRAMES


def roverflow(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


def test_info_says_what_a_log_holds(traverse, capsys):
    assert roverflow("info", traverse) == 0
    said = capsys.readouterr().out
    assert "/stereo/left/image_rect_color" in said
    assert f"{FRAMES}" in said


def test_info_looks_at_a_log_as_a_run_with_that_pipeline_would(traverse, tmp_path, capsys):
    def streams(*given):
        assert roverflow("info", traverse, "--json", *given) == 0
        return json.loads(capsys.readouterr().out)["streams"]

    pipeline = tmp_path / "tf.yaml"
    text = (SHIPPED / "rover.yaml").read_text()
    pipeline.write_text(text.replace("{use: recordings.McapSource}", "{use: recordings.McapSource, odometry: /nix}"))
    assert streams()["odometry"] == "/odometry"
    assert streams("-p", pipeline, "--set", "source.odometry=/odometry") == streams()
    assert "odometry" not in streams("-p", pipeline)


def test_info_says_that_it_cannot_look_through_a_source_of_another_kind(traverse, tmp_path, capsys):
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
    assert "tests.flow.toys.Source is no recordings.McapSource" in capsys.readouterr().err
