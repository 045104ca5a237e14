"""A logged pose that jumps is a warning: in one step that the images contradict, or where no image confirms it."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flow.contracts import Severity
from stages import CameraMotion, Mount, Pose, PoseFilter, Tilt, Transform
from stages.data import Array
from stages.localisation.pose_check import PoseCheck
from stages.localisation.pose_gaps import gap_problem
from tests.stages.running import Running

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


def parts(gap: float, place: Callable[[Transform], Array], cameras: Sequence[Transform] = DRIVE, segment: int = 2):
    """Two drives in one log, `gap` seconds apart; the second has its poses at `place` of its cameras."""
    first = [(motion_of(camera, number), pose_at(camera)) for number, camera in enumerate(cameras)]
    later = [len(cameras) / 2 - 0.5 + gap + number / 2 for number in range(len(cameras))]
    second = [
        (motion_of(camera, number, seconds, segment), pose_at(camera, place(camera)))
        for number, (camera, seconds) in enumerate(zip(cameras, later, strict=True))
    ]
    return zip(*first, *second, strict=True)


BACK, ASIDE = np.zeros(3), np.array([4.0, 2.0, 0.0])  # of the second drive; the first one ends at (5, 0)


@pytest.mark.parametrize(("gap", "start", "why"), [
    (3600, BACK, "moves by 5.0 m between 10.0 s and 3610.0 s after the first frame, back to where it began."),
    (12, BACK, "moves by 5.0 m between 10.0 s and 22.0 s after the first frame, back to where it began."),
    (12, ASIDE, "moves by 2.2 m between 10.0 s and 22.0 s after the first frame, against the direction of the drive"),
    (0.5, ASIDE, "between 10.0 s and 10.5 s after the first frame, at 4.5 m/s, though it drives at most 0.5 m/s"),
])  # fmt: skip
def test_odometry_that_starts_again_is_a_warning_with_its_time_and_size(gap, start, why):
    check = checked(*parts(gap, lambda camera: camera.translation + start))
    assert why in gap_problem(check.jumps)
    assert "run each part of the log alone with --start and --end" in gap_problem(check.jumps)


STOP_AND_GO = track(([0.0] * 5 + [STEP] + [0.0] * 4) * 2)


@pytest.mark.parametrize(("gap", "start", "cameras", "segment"), [
    (12, [10.5, 1, 0], DRIVE, 2),  # it drives on
    (12, [7.0, 0, 0], DRIVE, 2),  # it stops and drives on
    (3600, [5.2, 0.1, 0], DRIVE, 2),  # it stands
    (1.0, [5.5, 0, 0], DRIVE, 2),  # a lost frame
    (12, [-10, 0, 0], track([-STEP] * 20), 2),  # it drives on backwards
    (20, [6, 1, 0], STOP_AND_GO, 2),  # images only where it stands
    (12, [5, 4, 0], track([STEP] * 20, [0.0] * 19 + [60.0]), 2),  # in a curve
])  # fmt: skip
def test_a_drive_that_goes_on_without_images_is_no_warning(gap, start, cameras, segment):
    given = parts(gap, lambda camera: camera.translation + start, cameras, segment)
    assert gap_problem(checked(*given).jumps) == ""


def test_a_track_across_the_gap_confirms_the_pose():
    cameras = [replace(camera, translation=camera.translation + BACK) for camera in DRIVE]
    given = list(zip(*parts(12, lambda camera: camera.translation, cameras, segment=1), strict=True))
    assert gap_problem(checked(*zip(*given, strict=True)).jumps) == ""


def test_nothing_is_known_of_a_log_without_any_track():
    motions = [motion_of(camera, 0, 2.0 * number**3, number + 1) for number, camera in enumerate(DRIVE)]
    assert gap_problem(checked(motions, moved(DRIVE, 9.0)).jumps) == ""


def test_both_jumps_are_one_warning_of_the_run():
    motions, poses = parts(12, lambda camera: camera.translation + np.array([0, 0.3 * (camera.translation[0] > 1), 0]))
    stage = Running(PoseFilter())
    for motion, pose in zip(motions, poses, strict=True):
        stage(motion, Tilt(motion.stamp, UP), MOUNT, pose)
    found = stage.finding()
    assert found.severity == Severity.WARNING
    assert "back to where it began" in found.sentence
    assert "jumps 1 time relative to visual odometry, by up to 0.30 m" in found.sentence
