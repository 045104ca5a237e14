"""Tilt and overlap separate the errors of pose and map, whatever the pose states."""

import numpy as np
import pytest

from stages import Pose
from stages.terrain.map_levelling import MapLevelling, StatedErrors

STATED = StatedErrors(attitude=np.radians(0.05), height_drift=0.002, tilt_bias=0.0)
SURE = 1e-8 * np.eye(3)


def pose(x, z=0.0, covariance=None):
    return Pose(0, [x, 0, z], [0, 0, 0, 1], "odom", "base_link", covariance)


TILT_SIGMA = float(np.radians(0.2))


def driven(poses, ups, leans):
    """After a drive at height 0 whose overlaps are exact; and the planes of its frames.

    leans: (n, 2) rad, true up in the frame of the poses.
    """
    levelling = MapLevelling.begin(poses[0], STATED).tilted(ups[0], TILT_SIGMA).placed()
    planes = [levelling.plane(ups[0])]
    for at, up, lean in zip(poses[1:], ups[1:], leans[1:], strict=True):
        levelling = levelling.moved(at, STATED).tilted(up, TILT_SIGMA)
        shown = np.array([-at.position[2], *(lean - up[:2])]) + levelling.mean[3:6]
        levelling = levelling.overlapped(shown, SURE, up).corrected()
        planes.append(levelling.plane(up))
    return levelling, np.array(planes)


def noisy_ups(count, degrees=0.2):
    noise = np.radians(degrees) * np.random.default_rng(1).normal(size=(count, 2))
    return np.column_stack([noise, np.ones(count)])


def test_a_pose_that_leans_is_found_and_the_map_stays_upright():
    lean = np.radians(3.0)
    ups = noisy_ups(40) + np.array([lean, 0.0, 0.0])
    poses = [pose(0.3 * step, -np.sin(lean) * 0.3 * step) for step in range(40)]
    levelling, _ = driven(poses, ups, np.tile([lean, 0.0], (40, 1)))
    assert np.degrees(levelling.mean[1]) == pytest.approx(3.0, abs=0.1)
    assert levelling.mean[0] == pytest.approx(np.sin(lean) * 0.3 * 39, abs=0.02)
    assert np.abs(np.degrees(levelling.mean[4:6])).max() < 0.1


def test_noisy_tilts_hardly_move_frames_of_a_precise_pose():
    ups = noisy_ups(40)
    _, planes = driven([pose(0.3 * step) for step in range(40)], ups, np.zeros((40, 2)))
    assert np.degrees(np.abs(planes[:, 1:] + ups[:, :2]).max()) < 0.05
    assert np.abs(planes[:, 0]).max() < 0.005


def test_a_planar_pose_is_overruled_by_the_tilt():
    slopes = np.radians(4.0) * np.sin(0.7 * np.arange(40))
    ups = np.column_stack([slopes, np.zeros(40), np.ones(40)])
    _, planes = driven([pose(0.3 * step, covariance=1e-6 * np.eye(6)) for step in range(40)], ups, ups[:, :2])
    assert np.degrees(np.abs(planes[:, 1:]).max()) < 0.3


@pytest.mark.parametrize("stated", [np.zeros((6, 6)), np.full((6, 6), np.nan), np.diag([-1.0] * 6), np.eye(6) * 1e12])
def test_a_covariance_that_states_nothing_gives_finite_planes(stated):
    _, planes = driven([pose(0.3 * step, covariance=stated) for step in range(10)], noisy_ups(10), np.zeros((10, 2)))
    assert np.isfinite(planes).all()
    assert np.abs(planes).max() < 0.05


def test_a_pose_far_off_its_stated_errors_is_corrected_at_once():
    """The pose is 0.03 m too high, and states 1 mm."""
    levelling = MapLevelling.begin(pose(0.0), STATED).tilted(np.array([0, 0, 1.0]), TILT_SIGMA).placed()
    levelling = levelling.moved(pose(0.3, 0.03, covariance=1e-6 * np.eye(6)), STATED)
    levelling = levelling.overlapped(np.array([-0.03, 0, 0]), SURE, np.array([0, 0, 1.0]))
    assert levelling.mean[0] == pytest.approx(-0.03, abs=0.002)
    assert abs(levelling.mean[3]) < 0.002


def test_the_pitch_of_a_pose_leans_ahead_and_its_roll_sideways():
    begun = MapLevelling.begin(pose(0, covariance=np.diag([1, 1, 1, 4e-4, 9e-4, 1])), STATED)
    np.testing.assert_allclose(np.diag(begun.covariance)[1:3], [9e-4, 4e-4])


def test_a_pose_whose_covariance_grows_may_have_moved_that_far():
    before = MapLevelling.begin(pose(0, covariance=1e-4 * np.eye(6)), STATED)
    grown = before.moved(pose(0, covariance=5e-4 * np.eye(6)), STATED)
    assert grown.covariance[0, 0] == pytest.approx(4e-4, rel=0.01)
