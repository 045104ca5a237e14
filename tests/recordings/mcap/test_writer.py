"""A written log is complete under its name or absent, whatever happens."""

import os
from pathlib import Path

import numpy as np
import pytest

from recordings.errors import LogError
from recordings.mcap.file import iter_decoded
from recordings.mcap.writer import Ros2Writer
from recordings.ros2.to_msg import image
from tests.limits import file_size_limited


def test_a_log_gets_its_name_when_it_is_complete(tmp_path):
    path = tmp_path / "out.mcap"
    path.write_bytes(b"the log before")
    with Ros2Writer(path) as writer:
        writer.write("/image", image(1, "cam", np.zeros((2, 2), np.uint8)), 1)
        writer.abort()
    assert path.read_bytes() == b"the log before"
    assert list(tmp_path.iterdir()) == [path]


def test_an_unwritable_path_is_named(tmp_path):
    with pytest.raises(LogError, match=r"cannot write .*nowhere/out\.mcap: No such file"):
        Ros2Writer(tmp_path / "nowhere" / "out.mcap")


def test_an_output_that_is_a_folder_is_refused_at_once(tmp_path):
    (tmp_path / "out.mcap").mkdir()
    with pytest.raises(LogError, match=r"cannot write .*out\.mcap: it is a folder"):
        Ros2Writer(tmp_path / "out.mcap")
    writer = Ros2Writer(tmp_path / "late.mcap")
    (tmp_path / "late.mcap").mkdir()
    with pytest.raises(LogError, match=r"cannot write .*late\.mcap: Is a directory"):
        writer.close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["late.mcap", "out.mcap"]


def test_two_writers_of_one_path_each_write_a_complete_log(tmp_path):
    path = tmp_path / "out.mcap"
    writers = [Ros2Writer(path), Ros2Writer(path)]
    for number in range(1, 50):
        for place, writer in enumerate(writers):
            writer.write(f"/image{place}", image(number, "cam", np.zeros((200, 200), np.uint8)), number)
    for place, writer in enumerate(writers):
        writer.close()
        assert [topic for topic, _, _ in iter_decoded(path)] == [f"/image{place}"] * 49
    assert list(tmp_path.iterdir()) == [path]


def test_a_log_is_renamed_after_it_is_on_the_disk(tmp_path, monkeypatch):
    order: list[str] = []
    settle, replace = os.fsync, Path.replace
    monkeypatch.setattr(os, "fsync", lambda number: (order.append("settled"), settle(number))[1])
    monkeypatch.setattr(Path, "replace", lambda *paths: (order.append("named"), replace(*paths))[1])
    Ros2Writer(tmp_path / "out.mcap").close()
    assert order == ["settled", "named", "settled"]


@pytest.mark.parametrize("stamp", [-1, 2**31 * 10**9])
def test_a_stamp_outside_ros_time_is_refused(tmp_path, stamp):
    with Ros2Writer(tmp_path / "out.mcap") as writer:
        with pytest.raises(ValueError, match=f"the stamp {stamp} ns is outside ROS time"):
            writer.write("/image", image(1, "cam", np.zeros((2, 2), np.uint8)), stamp)
        writer.abort()


def test_a_full_disk_is_reported_and_leaves_no_file(tmp_path):
    writer = Ros2Writer(tmp_path / "out.mcap")
    noise = np.random.default_rng(0).integers(0, 256, (512, 512), dtype=np.uint8)
    with file_size_limited(300_000):
        writer.write("/image", image(1, "cam", noise), 1)
        with pytest.raises(LogError, match=r"cannot write .*out\.mcap: File too large"):
            writer.write("/image", image(2, "cam", noise), 2)
    writer.close()
    assert list(tmp_path.iterdir()) == []
