"""What `info` reports of the poses of a log."""

import math

import pytest

from recordings.inventory import poses
from recordings.inventory.text import format_description
from tests.conftest import rewrite
from tests.recordings.sample_log import FRAMES, TILT, changed, inventory_of, write_sample

ROTATION = "pose.pose.orientation"


@pytest.mark.parametrize("most", [poses.MAX_READ, 1])
def test_poses_that_a_run_would_lose_are_damage(tmp_path, monkeypatch, most):
    monkeypatch.setattr(poses, "MAX_READ", most)
    broken = changed("/odom", {"pose.pose.position.x": math.nan}, range(1, 3))
    described = inventory_of(write_sample(tmp_path / "log.mcap", broken))
    (damage,) = described["damage"]
    assert damage.startswith("2 similar, first: /odom at ")
    assert "the position of the pose is [nan, " in damage
    assert "source.odometry" not in format_description(described)


@pytest.mark.parametrize("most", [poses.MAX_READ, 1])
def test_a_log_without_any_readable_pose_names_visual_odometry(tmp_path, monkeypatch, most):
    monkeypatch.setattr(poses, "MAX_READ", most)
    zero = changed("/odom", {f"{ROTATION}.{name}": 0.0 for name in "xyzw"})
    described = inventory_of(write_sample(tmp_path / "log.mcap", zero))
    assert described["damage"][0].startswith(f"{FRAMES} similar, first: /odom at ")
    doubt = "doubtful: no pose on /odom can be read; --set source.odometry=visual makes a run do without them"
    assert doubt in format_description(described)


@pytest.mark.parametrize("most", [poses.MAX_READ, 1])
def test_each_stream_of_another_clock_than_the_images_has_its_setting(tmp_path, monkeypatch, most):
    monkeypatch.setattr(poses, "MAX_READ", most)
    seconds = {"header.stamp.sec": lambda seconds: seconds + 1000}
    text = format_description(inventory_of(write_sample(tmp_path / "log.mcap", changed((TILT, "/odom"), seconds))))
    for what, stream in (("tilts", "inclinometer"), ("poses", "odometry")):
        assert f"the stamps of {what} and images are of clocks that differ by 1000.0 s" in text
        assert f"--set source.time_offset.{stream}=-1000.000s corrects the {what}" in text


def test_poses_that_are_only_logged_late_are_not_of_another_clock(tmp_path):
    late = tmp_path / "late.mcap"
    rewrite(write_sample(tmp_path / "log.mcap"), late, time=lambda topic, at: at + (topic == "/odom") * 5_000_000_000)
    assert "of clocks that differ" not in format_description(inventory_of(late))
