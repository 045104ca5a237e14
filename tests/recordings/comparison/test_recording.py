"""The recording of a difference."""

import numpy as np
import pytest

import recordings.comparison.recording
from recordings.comparison.diff import MessageDifference
from recordings.comparison.recording import DiffRecording
from recordings.ros2.to_msg import occupancy_grid, odometry
from stages.data import NavigationMap, Pose

MAX_FRAMES = 3


@pytest.fixture(autouse=True)
def few_frames(monkeypatch):
    monkeypatch.setattr(recordings.comparison.recording, "MAX_FRAMES", MAX_FRAMES)


def test_frames_beyond_the_largest_number_are_counted_once_for_all_their_topics():
    recording, cells = DiffRecording(), np.zeros((2, 2), np.int8)
    message = occupancy_grid(NavigationMap(0, cells, cells.view(np.uint8), 0.1, (0.0, 0.0), "odom"))
    for stamp in range(MAX_FRAMES + 3):
        for topic in ("/nav/navigation_map", "/nav/regional_navigation_map"):
            recording.of()(MessageDifference(topic, stamp, message, message, {}))
    assert len(recording.left_out) == 3
    assert len(recording.pictures) == 2 * MAX_FRAMES


def test_topics_without_pages_take_no_room_from_others():
    recording, cells = DiffRecording(), np.zeros((2, 2), np.int8)
    pose = odometry(Pose(0, np.zeros(3), np.array([0.0, 0, 0, 1]), "odom", "base_link", None))
    for stamp in range(MAX_FRAMES + 3):
        recording.of()(MessageDifference("/nav/pose", stamp, pose, pose, {}))
    grid = occupancy_grid(NavigationMap(0, cells, cells.view(np.uint8), 0.1, (0.0, 0.0), "odom"))
    recording.of()(MessageDifference("/nav/navigation_map", stamp, grid, grid, {}))
    assert len(recording.pictures) == 1
    assert not recording.left_out
