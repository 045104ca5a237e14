"""The recording of a difference."""

import numpy as np

from recordings.comparison.diff import MessageDifference
from recordings.comparison.recording import MAX_FRAMES, DiffRecording
from recordings.ros2.to_msg import occupancy_grid
from stages.data import NavigationMap


def test_frames_beyond_the_largest_number_are_counted_once_for_all_their_topics():
    recording, cells = DiffRecording(), np.zeros((2, 2), np.int8)
    message = occupancy_grid(NavigationMap(0, cells, cells.view(np.uint8), 0.1, (0.0, 0.0), "odom"))
    for stamp in range(MAX_FRAMES + 3):
        for topic in ("/nav/navigation_map", "/nav/regional_navigation_map"):
            recording.of()(MessageDifference(topic, stamp, message, message, {}))
    assert len(recording.left_out) == 3
    assert len(recording.pictures) == 2 * MAX_FRAMES
