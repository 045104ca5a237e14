"""A logged pose that jumps is a warning: in one step that the images contradict, or where no image confirms it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages import CameraMotion, Mount, Pose, Transform
from stages.data import Array
from stages.localisation.pose_check import PoseCheck

SECOND = 1_000_000_000
MOUNT = Mount(0, np.eye(3))
UP = np.array([0.0, 0.0, 1.0])
STEP = 0.25  # m, in half a second


def track(lengths: Sequence[float], turns: Sequence[float] = ()) -> list[Transform]:
    """The camera, z up, after steps of these lengths, m, each after a turn to the left, degrees."""
    turned, place, cameras = 0.0, np.zeros(3), [Transform("start", "camera", np.eye(3), np.zeros(3))]
    for length, turn in zip(lengths, turns or [0.0] * len(lengths), strict=True):
        turned += turn
        rotation = Rotation.from_euler("z", turned, degrees=True)
        place = place + rotation.apply([length, 0.0, 0.0])
        cameras.append(Transform("start", "camera", rotation.as_matrix(), place))
    return cameras


DRIVE = track([STEP] * 20)


def motion_of(camera: Transform, number: int, seconds: float | None = None, segment: int = 1) -> CameraMotion:
    """A frame of visual odometry whose steps have a sigma of 2 mm per axis. seconds: its time."""
    stamp = round((number / 2 if seconds is None else seconds) * SECOND)
    return CameraMotion(stamp, segment, camera, number * 4e-6 * np.eye(6), inliers=900)


def pose_at(camera: Transform, place: Array | None = None) -> Pose:
    quaternion = Rotation.from_matrix(camera.rotation).as_quat()
    return Pose(0, camera.translation if place is None else place, quaternion, "odom", "camera")


def checked(motions: Sequence[CameraMotion], poses: Sequence[Pose]) -> PoseCheck:
    check = PoseCheck()
    for motion, pose in zip(motions, poses, strict=True):
        check.add(motion, pose, MOUNT, UP)
    return check


def moved(cameras: Sequence[Transform], size: float, since: int = 8, until: int = 999) -> list[Pose]:
    """The poses of cameras, displaced to the side from one frame on."""
    shift = np.array([0.0, size, 0.0])
    return [pose_at(one, one.translation + shift * (since <= at < until)) for at, one in enumerate(cameras)]


@pytest.mark.parametrize(("poses", "problem"), [
    (moved(DRIVE, 0.5), "jumps 1 time relative to visual odometry, by up to 0.50 m, first at the frame 4.0 s after"),
    (moved(DRIVE, 0.22), "jumps 1 time relative to visual odometry, by up to 0.22 m, first at the frame 4.0 s after"),
    (moved(DRIVE, 0.18), ""),
    (moved(DRIVE, 0.3, until=9), "jumps 2 times relative to visual odometry, by up to 0.30 m, first at the frame 4.0"),
])  # fmt: skip
def test_a_step_off_the_images_by_more_than_both_explain_is_a_jump(poses, problem):
    found = checked([motion_of(camera, number) for number, camera in enumerate(DRIVE)], poses).problem()
    assert problem in found
    assert bool(found) == bool(problem)


def slipped(number: int, camera: Transform, last: int) -> Transform:
    """Visual odometry that is wrong by 0.4 m from frame 8 to the last one."""
    return replace(camera, translation=camera.translation + np.array([0.4, 0, 0]) * (8 <= number <= last))


@pytest.mark.parametrize(("change", "jump"), [
    (lambda number, motion: replace(motion, inliers=60), 0.4),
    (lambda number, motion: replace(motion, covariance=number * 2e-3 * np.eye(6)), 0.4),
    (lambda number, motion: replace(motion, camera=slipped(number, motion.camera, 8)), 0.0),
    (lambda number, motion: replace(motion, camera=slipped(number, motion.camera, 99)), 0.0),
], ids=["few inliers", "large sigma", "wrong there and back", "wrong once"])  # fmt: skip
def test_visual_odometry_that_is_doubtful_contradicts_nothing(change, jump):
    motions = [change(number, motion_of(camera, number)) for number, camera in enumerate(DRIVE)]
    assert checked(motions, moved(DRIVE, jump)).problem() == ""


def noisy(cameras: Sequence[Transform], sigma: float) -> list[Pose]:
    noise = np.random.default_rng(0).normal(0, sigma, (len(cameras), 3))
    return [pose_at(camera, camera.translation + off) for camera, off in zip(cameras, noise, strict=True)]


@pytest.mark.parametrize(("cameras", "poses"), [
    (track([0.5] * 400), lambda cameras: noisy(cameras, 0.05)),
    (track([0.0] * 20), lambda cameras: noisy(cameras, 0.003)),
    (track([0.0] * 5 + [STEP] + [0.0] * 5 + [STEP] * 9), lambda cameras: moved(cameras, 0.0)),
    (track([-STEP] * 20), lambda cameras: moved(cameras, 0.0)),
    (track([1.5] * 20), lambda cameras: [pose_at(one, 1.1 * one.translation) for one in cameras]),
    (track([0.0] * 20, [25.0] * 20), lambda cameras: noisy(cameras, 0.01)),
], ids=["noise", "standing", "stop and go", "backwards", "slip of long steps", "turning in place"])  # fmt: skip
def test_sound_and_noisy_odometry_does_not_jump(cameras, poses):
    motions = [motion_of(camera, number) for number, camera in enumerate(cameras)]
    check = checked(motions, poses(cameras))
    assert check.jumps.contradicted() == []
