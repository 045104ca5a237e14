"""Pose errors are errors of the path; origin and heading of the frame of reference do not matter."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recordings.ros2.to_msg import odometry
from recordings.scoring.pose_metrics import PoseTally
from recordings.scoring.table import pose_lines
from stages.data import Pose


def pose(place, heading=0.0, frame="odom", child="base_link"):
    """A pose with some roll, as a message."""
    turn = Rotation.from_euler("ZYX", [heading, 0.05, -0.1])
    return odometry(Pose(0, place, turn.as_quat(), frame, child))


def tallied(pairs):
    tally = PoseTally()
    for true, given in pairs:
        tally.add(true, given)
    return tally.metrics()


def test_poses_in_another_frame_of_reference_have_no_error():
    turn, shift = Rotation.from_euler("z", 1.1), np.array([5.0, -3.0, 2.0])
    places = np.array([[0, 0, 0], [1, 0.2, 0.1], [2, 1, 0.3]], float)
    found = tallied(
        (pose(turn.apply(place) + shift, 1.1 + heading, "world"), pose(place, heading))
        for place, heading in zip(places, (0.0, 0.3, 0.9), strict=True)
    )
    assert found["drift"] == pytest.approx(0, abs=1e-12)
    assert found["max_heading_error"] == pytest.approx(0, abs=1e-12)
    assert found["distance"] == pytest.approx(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())


def test_the_drift_is_the_last_error_over_the_distance_driven():
    found = tallied([
        (pose([0, 0, 0]), pose([0, 0, 0])),
        (pose([4, 0, 0]), pose([4.5, 0, 0], 0.2)),
        (pose([0, 0, 0]), pose([0.04, 0.03, 0], -0.1)),
    ])  # fmt: skip
    assert found["drift"] == pytest.approx(0.05 / 8)
    assert (found["max_error"], found["max_heading_error"]) == (pytest.approx(0.5), pytest.approx(0.2))


def test_each_part_is_aligned_again_and_adds_its_error_and_distance():
    found = tallied([
        (pose([0, 0, 0]), pose([0, 0, 0], frame="visual_odom")),
        (pose([1, 0, 0]), pose([1.02, 0, 0], frame="visual_odom")),
        (pose([2, 0, 0]), None),
        (pose([3, 0, 0]), pose([0, 0, 0], frame="visual_odom/2")),
        (pose([6, 0, 0]), pose([2.94, 0, 0], frame="visual_odom/2")),
    ])  # fmt: skip
    assert found["drift"] == pytest.approx((0.02 + 0.06) / (1 + 3))
    assert (found["parts"], found["frames"], found["missing"]) == (2, 4, 1)
    first, second = pose_lines(found)
    assert "drift 2.00% of 4.00 m driven; largest error 6.0 cm, 0.00 deg; 2 parts in frames of their own" in first
    assert "not scored in 1 frame: the result has no pose" in second


def test_without_a_pose_there_are_no_metrics():
    assert tallied([(pose([0, 0, 0]), None)]) is None
