"""PoseFilter makes visual poses, upright by the tilt, and reports their source."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flow.contracts import Finding, Severity
from recordings.simulator.traverse import level_pose
from stages import Mount, Pose, PoseFilter, Tilt, Transform
from stages.data import Array
from stages.localisation.pose_check import PoseCheck
from stages.localisation.pose_filter import SCALE_ERROR, _common_errors
from tests.stages.localisation.drive import FRAMES, Drive, motions, readings
from tests.stages.running import Running

DRIVE = Drive(2, 6.0)
READINGS = readings(DRIVE)
FIRST, UPRIGHT = READINGS[0]
LOGGED = Pose(7, [1, 2, 3], [0, 0, 0, 1], "odom", "base_link")


def mount_of(drive: Drive, based: bool = True) -> Mount:
    return Mount(0, drive.mount, drive.truth.mounts[0] if based else None)


MOUNT = mount_of(DRIVE)


def located(drive: Drive, stage: Running, based: bool = True) -> list[Pose]:
    return [stage(*reading, mount_of(drive, based)) for reading in readings(drive)]


def errors(drive: Drive, poses: list[Pose]) -> tuple[Array, Array]:
    """Of positions, m, and turns, degrees, (n, 3) each, against the truth since the first frame."""
    start = level_pose(drive.truth.base_at(drive.stamps()[0])).inverse()
    places, turns = [], []
    for pose in poses:
        true = start.after(drive.truth.base_at(pose.stamp))
        places.append(pose.position - true.translation)
        turns.append((Rotation.from_quat(pose.quaternion) * Rotation.from_matrix(true.rotation).inv()).as_rotvec())
    return np.array(places), np.degrees(turns)


def test_visual_poses_of_base_link_follow_the_drive():
    stage = Running(PoseFilter())
    poses = located(DRIVE, stage)
    places, turns = errors(DRIVE, poses)
    assert {(pose.frame_id, pose.child_frame_id) for pose in poses} == {("visual_odom", "base_link")}
    np.testing.assert_allclose(poses[0].position, 0, atol=1e-12)
    assert np.linalg.norm(places[-1]) < 0.05  # of 12 m, from the noise of the first tilt
    assert np.abs(turns[:, 2]).max() < 0.1
    sentence = f"Visual odometry supplies the pose ({FRAMES} poses, frame visual_odom)."
    assert stage.finding() == Finding(sentence)


def test_the_tilt_is_smoothed_along_the_images():
    """Roll and pitch are better than any single tilt, and do not drift."""
    _, turns = errors(DRIVE, located(DRIVE, Running(PoseFilter(tilt_noise=float(np.radians(0.15))))))
    assert np.sqrt(np.mean(np.square(turns[20:, :2]))) < 0.4 * 0.3 * 0.45
    tilted, leaning = Drive(2, 6.0, noise=0.0), np.radians(0.1)  # the images lean over by 0.1 degrees a frame
    stage, leans = Running(PoseFilter()), []
    for count, (motion, tilt) in enumerate(readings(tilted)):
        lean = Rotation.from_rotvec([0, 0, leaning * count]).as_matrix()
        wrong = Transform(motion.camera.parent, motion.camera.child, lean @ motion.camera.rotation, np.zeros(3))
        drifting = replace(motion, camera=wrong, covariance=np.eye(6) * leaning**2 * count)
        pose = stage(drifting, tilt, mount_of(tilted))
        z = Rotation.from_quat(pose.quaternion).as_matrix()[2]
        leans.append(np.degrees(np.arccos(np.clip(z @ tilted.truth.base_at(motion.stamp).rotation[2], -1, 1))))
    assert max(leans) < 1.0  # 5 degrees without the tilt


def test_the_covariance_covers_the_errors_and_grows():
    for seed in (2, 3, 4):
        drive = Drive(seed, 6.0)
        poses = located(drive, Running(PoseFilter(tilt_noise=float(np.radians(0.15)))))
        places, turns = errors(drive, poses)
        spread = np.array([np.sqrt(np.diag(pose.covariance)) for pose in poses[1:]])
        found = np.abs(np.hstack([places, np.radians(turns)]))[1:]
        assert np.mean(found < 2 * spread + 1e-6) > 0.9
        assert spread[-1, 0] > spread[5, 0]
        assert spread[-1, 5] > spread[5, 5]


def test_a_frame_known_better_than_the_one_before_does_not_change_the_errors():
    """Both are tracked from one keyframe; what they have in common is unknown."""
    stage, mount = Running(PoseFilter()), mount_of(DRIVE, based=False)
    seen = [replace(FIRST, covariance=variance * np.eye(6)) for variance in (0, 4e-4, 1e-4)]
    variances = [stage(motion, UPRIGHT, mount).covariance[0, 0] for motion in seen]
    np.testing.assert_allclose(variances, [0, 4e-4, 4e-4])


def test_a_rover_that_stands_does_not_move_with_the_noise_of_its_tilt():
    """Each tilt moves the camera, 1 m from base_link, but not base_link."""
    noise, rng, places, stated = np.radians(0.5), np.random.default_rng(0), [], []
    camera = DRIVE.truth.base_at(DRIVE.stamps(1)[0]).after(DRIVE.truth.mounts[0])
    for _ in range(20):
        stage = Running(PoseFilter(tilt_noise=float(noise), tilt_bias=0.0))
        for motion in motions([camera] * 10, list(range(10))):
            wrong = Rotation.from_rotvec([*rng.normal(0, noise, 2), 0.0]).as_matrix()
            up = DRIVE.mount.T @ camera.rotation.T @ wrong[:, 2]
            pose = stage(motion, Tilt(motion.stamp, up), MOUNT)
        places.append(pose.position)
        stated.append(np.sqrt(np.diag(pose.covariance)[:3]))
    assert np.abs(places).max() < 5e-4
    assert np.max(stated) < 5e-4


def test_the_error_of_a_filtered_tilt_does_not_average_out():
    spreads = []
    for filtered in (False, True):
        stage = Running(PoseFilter(tilt_bias=0.0))
        for motion, tilt in READINGS:
            pose = stage(motion, replace(tilt, sigma=0.005, filtered=filtered), MOUNT)
        spreads.append(np.sqrt(np.diag(pose.covariance)))
    assert max(spreads[0][3:5]) < 0.004
    assert min(spreads[1][3:5]) > 0.005
    assert spreads[1][2] > spreads[0][2]


def test_a_logged_pose_passes_through_unchanged():
    stage = Running(PoseFilter())
    for motion in (FIRST, replace(FIRST, camera=None, lost="dark")):
        assert stage(motion, UPRIGHT, MOUNT, LOGGED) is LOGGED
    assert stage.finding() is None


def test_poses_after_lost_tracking_are_in_a_frame_of_their_own():
    cameras, stamps, stage = DRIVE.cameras(6), DRIVE.stamps(6), Running(PoseFilter())
    given = [*motions(cameras[:3], stamps[:3]), *motions(cameras[3:], stamps[3:], segment=2)]
    poses = [stage(motion, tilt, MOUNT) for motion, (_, tilt) in zip(given, READINGS, strict=False)]
    assert [pose.frame_id for pose in poses] == ["visual_odom"] * 3 + ["visual_odom/2"] * 3
    np.testing.assert_allclose(poses[3].position, 0, atol=1e-12)
    sentence = (
        "Visual odometry supplies the pose (6 poses). It lost track 1 time: the poses are in 2 "
        "unaligned frames, visual_odom and visual_odom/2."
    )
    assert stage.finding() == Finding(sentence, Severity.WARNING)


def test_lost_tracking_is_a_note_if_the_log_contains_poses():
    stage = Running(PoseFilter())
    for segment in (1, 2, 3):
        stage(replace(FIRST, segment=segment), UPRIGHT, MOUNT, LOGGED)
    assert stage.finding() == Finding("Visual odometry lost track 2 times. The poses are those of the log.")


def askew(number, pose):
    turned = Rotation.from_euler("z", 90, degrees=True) * Rotation.from_quat(pose.quaternion)
    return replace(pose, quaternion=turned.as_quat())


@pytest.mark.parametrize("based", [True, False])
@pytest.mark.parametrize(("change", "sentence"), [
    (lambda number, pose: pose, None),
    (lambda number, pose: replace(pose, position=1.1 * pose.position), None),  # slip
    (lambda number, pose: replace(pose, position=pose.position / 1.1),
     r"are 10 % longer than those of the logged odometry \(\d\d steps\), which slip does not explain"),
    (lambda number, pose: replace(pose, position=pose.position / 2), r"are \d\d+ % longer than those of the logged"),
    (lambda number, pose: replace(pose, position=np.zeros(3)),
     r"disagrees with visual odometry: median step 0\.0\d m vs 0\.\d\d m"),
    (askew, "disagrees with visual odometry"),
    (lambda number, pose: replace(pose, position=pose.position + 5.0 * (number > 9)),
     r"jumps 1 time relative to visual odometry, by up to 8\.\d m"),
], ids=["alike", "longer", "shorter", "half", "frozen", "askew", "leaping"])  # fmt: skip
def test_a_logged_pose_that_disagrees_with_the_images_is_a_warning(change, sentence, based):
    stage, mount = Running(PoseFilter()), mount_of(DRIVE, based)
    for number, pose in enumerate(located(DRIVE, Running(PoseFilter()), based)):
        logged = change(number, pose)
        assert stage(*READINGS[number], mount, logged) is logged
    found = stage.finding()
    assert (found is None) == (sentence is None)
    if found:
        assert re.search(sentence, found.sentence)
        assert found.severity == Severity.WARNING


def with_jump(usual, longest):
    return [(1.0, 1.0, difference) for difference in [usual] * 10 + [longest]]


@pytest.mark.parametrize(("steps", "problem"), [
    ([(1.0, 0.2, 0.8)] * 4, ""),
    ([(1.0, 0.2, 0.8)] * 5, "disagrees with visual odometry"),
    ([(1.1, 1.0, 0.1)] * 9, ""),
    ([(1.1, 1.0, 0.1)] * 10, "10 % longer"),
    ([(0.019, 0.0, 0.019)] * 10, ""),  # noise of a rover that stands
    (with_jump(0.01, 0.6), "jumps 1 time"), (with_jump(0.01, 0.4), ""),
    (with_jump(0.1, 1.2), "jumps 1 time"), (with_jump(0.1, 0.9), ""),
])  # fmt: skip
def test_few_and_short_steps_are_not_judged_and_a_jump_is_long_and_ten_times_the_usual_difference(steps, problem):
    found = PoseCheck(steps=[np.array(step) for step in steps]).problem()
    assert problem in found
    assert bool(found) == bool(problem)


UP = np.array([0.0, -1.0, 0.0])  # in a level camera
FORWARD = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # the camera of a rover


def bend(number):
    """The heading at a frame, degrees."""
    return 7.0 * max(number - 19, 0)


def level_turn(degrees):
    return Rotation.from_euler("z", degrees, degrees=True).as_quat()


def test_no_step_leads_over_lost_tracking():
    check, camera = PoseCheck(), FIRST.camera
    far = replace(camera, translation=camera.translation + 9.0)
    lost = replace(FIRST, camera=None)
    for motion in (FIRST, lost, replace(FIRST, camera=far), replace(FIRST, segment=2), replace(FIRST, segment=2)):
        check.add(motion, LOGGED, MOUNT, UP)
    np.testing.assert_array_equal(check.steps, np.zeros((1, 3)))


@pytest.mark.parametrize(("wrong", "problem"), [
    (lambda number, pose: pose, ""),
    (lambda number, pose: replace(pose, quaternion=level_turn(0)), "0.6 m and 0 degrees against 0.6 m and 21 by"),
    (lambda number, pose: replace(pose, quaternion=level_turn(1.3 * bend(number))), ""),  # as skid steering states it
    (lambda number, pose: replace(pose, position=pose.position - [0.21 * np.clip(number - 8, 0, 10), 0, 0]),
     "in 2 of 7 stretches of the drive, first with 0.0 m and 0 degrees against 1.0 m and 0 by the"),
    (lambda number, pose: replace(pose, position=pose.position + np.array([20.0 * (6 < number < 12), 0, 0])),
     "jumps 2 times relative to visual odometry, by up to 20.0 m"),
], ids=["right", "no heading", "turns too far", "stuck", "there and back"])  # fmt: skip
def test_a_pose_that_is_wrong_in_a_part_of_the_drive_is_a_warning(wrong, problem):
    """The rover drives straight for 20 frames and then turns by 7 degrees in each of 10. Most steps are right."""
    check, place = PoseCheck(), np.zeros(3)
    for number in range(30):
        turn = Rotation.from_quat(level_turn(bend(number)))
        place = place + turn.apply([0.21, 0.0, 0.0])
        seen = Transform("start", "camera", (turn * FORWARD).as_matrix(), place)
        pose = wrong(number, Pose(number, place, turn.as_quat(), "odom", "camera"))
        pose = replace(pose, quaternion=(Rotation.from_quat(pose.quaternion) * FORWARD).as_quat())
        check.add(replace(FIRST, camera=seen), pose, MOUNT, UP)
    found = check.problem()
    assert problem in found
    assert bool(found) == bool(problem)


def test_the_error_of_all_steps_is_half_as_large_sideways():
    errors = _common_errors(np.array([10.0, 0.0, 0.0]), 0.0, 0.0)
    along = 10 * SCALE_ERROR
    np.testing.assert_allclose(np.linalg.norm(errors, axis=0), [along, along / 2, 0, 0, 0, 0])


def test_an_exact_tilt_and_an_exact_motion_give_poses():
    stage = Running(PoseFilter())
    exact = replace(UPRIGHT, sigma=0.0)
    poses = [stage(replace(FIRST, covariance=np.zeros((6, 6))), exact, MOUNT) for _ in range(3)]
    assert np.isfinite([pose.covariance for pose in poses]).all()


def test_without_base_link_the_pose_is_that_of_the_camera():
    poses = located(DRIVE, Running(PoseFilter()), based=False)
    assert poses[0].child_frame_id == DRIVE.truth.mounts[0].child
    first, last = (DRIVE.cameras()[frame].translation for frame in (0, -1))
    assert abs(np.linalg.norm(poses[-1].position) - np.linalg.norm(last - first)) < 0.05
    axis = Rotation.from_quat(poses[0].quaternion).as_matrix()[:, 2]
    assert abs(axis[1]) < 1e-9  # the optical axis is the heading


def test_a_frame_without_motion_is_refused():
    motion = replace(FIRST, camera=None, lost="only 3 features have a disparity")
    with pytest.raises(ValueError, match="no pose from the images: only 3 features have a disparity"):
        Running(PoseFilter())(motion, UPRIGHT, MOUNT)
