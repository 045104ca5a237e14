"""PoseFilter makes visual poses, upright by the tilt, and reports their source."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flow.contracts import Finding, Severity
from recordings.simulator.traverse import level_pose
from stages import Mount, Pose, PoseFilter, Tilt, Transform
from stages.data import Array
from tests.stages.localisation.drive import FRAMES, Drive, motions
from tests.stages.running import Running

DRIVE = Drive(2, 6.0)


def mount_of(drive: Drive, based: bool = True) -> Mount:
    return Mount(0, drive.mount, drive.truth.mounts[0] if based else None)


def located(drive: Drive, stage: Running, based: bool = True) -> list[Pose]:
    mount, ups = mount_of(drive, based), drive.ups()
    given = motions(drive.cameras(), drive.stamps())
    return [stage(motion, Tilt(motion.stamp, up), mount) for motion, up in zip(given, ups, strict=True)]


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
    sentence = f"The log contains no pose. Visual odometry supplies it ({FRAMES} poses, frame visual_odom)."
    assert stage.finding() == Finding(sentence)


def test_the_tilt_is_smoothed_along_the_images():
    """Roll and pitch are better than any single tilt, and do not drift."""
    _, turns = errors(DRIVE, located(DRIVE, Running(PoseFilter(tilt_noise=float(np.radians(0.15))))))
    assert np.sqrt(np.mean(np.square(turns[20:, :2]))) < 0.4 * 0.3 * 0.45
    tilted = Drive(2, 6.0, noise=0.0)
    mount, given = mount_of(tilted), motions(tilted.cameras(), tilted.stamps())
    leaning = np.radians(0.1)  # the images lean over by 0.1 degrees a frame
    stage, leans = Running(PoseFilter()), []
    for count, (motion, up) in enumerate(zip(given, tilted.ups(), strict=True)):
        assert motion.camera is not None
        lean = Rotation.from_rotvec([0, 0, leaning * count]).as_matrix()
        wrong = Transform(motion.camera.parent, motion.camera.child, lean @ motion.camera.rotation, np.zeros(3))
        drifting = replace(motion, camera=wrong, covariance=np.eye(6) * leaning**2 * count)
        pose = stage(drifting, Tilt(motion.stamp, up), mount)
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


def test_a_rover_that_stands_does_not_move_with_the_noise_of_its_tilt():
    """Each tilt moves the camera, 1 m from base_link, but not base_link."""
    noise, rng, places, stated = np.radians(0.5), np.random.default_rng(0), [], []
    camera = DRIVE.truth.base_at(DRIVE.stamps(1)[0]).after(DRIVE.truth.mounts[0])
    for _ in range(20):
        stage = Running(PoseFilter(tilt_noise=float(noise), tilt_bias=0.0))
        for motion in motions([camera] * 10, list(range(10))):
            wrong = Rotation.from_rotvec([*rng.normal(0, noise, 2), 0.0]).as_matrix()
            up = DRIVE.mount.T @ camera.rotation.T @ wrong[:, 2]
            pose = stage(motion, Tilt(motion.stamp, up), mount_of(DRIVE))
        places.append(pose.position)
        stated.append(np.sqrt(np.diag(pose.covariance)[:3]))
    assert np.abs(places).max() < 5e-4
    assert np.max(stated) < 5e-4


def test_the_error_of_a_filtered_tilt_does_not_average_out():
    spreads = []
    for filtered in (False, True):
        stage = Running(PoseFilter(tilt_bias=0.0))
        for motion, up in zip(motions(DRIVE.cameras(), DRIVE.stamps()), DRIVE.ups(), strict=True):
            pose = stage(motion, Tilt(motion.stamp, up, sigma=0.005, filtered=filtered), mount_of(DRIVE))
        spreads.append(np.sqrt(np.diag(pose.covariance)))
    assert max(spreads[0][3:5]) < 0.004
    assert min(spreads[1][3:5]) > 0.005
    assert spreads[1][2] > spreads[0][2]


def test_a_logged_pose_passes_through_unchanged():
    pose = Pose(7, [1, 2, 3], [0, 0, 0, 1], "odom", "base_link")
    motion = motions(DRIVE.cameras(1), DRIVE.stamps(1))[0]
    stage = Running(PoseFilter())
    given = (Tilt(7, DRIVE.ups(1)[0]), mount_of(DRIVE))
    assert stage(motion, *given, pose) is pose
    assert stage(replace(motion, camera=None, lost="dark"), *given, pose) is pose
    assert stage.finding() is None


def test_poses_after_lost_tracking_are_in_a_frame_of_their_own():
    cameras, stamps, ups = DRIVE.cameras(6), DRIVE.stamps(6), DRIVE.ups(6)
    given = [*motions(cameras[:3], stamps[:3]), *motions(cameras[3:], stamps[3:], segment=2)]
    stage = Running(PoseFilter())
    poses = [stage(motion, Tilt(motion.stamp, up), mount_of(DRIVE)) for motion, up in zip(given, ups, strict=True)]
    assert [pose.frame_id for pose in poses] == ["visual_odom"] * 3 + ["visual_odom/2"] * 3
    np.testing.assert_allclose(poses[3].position, 0, atol=1e-12)
    sentence = (
        "The log contains no pose. Visual odometry supplies it (6 poses). It lost track 1 time: the poses are in 2 "
        "unaligned frames, visual_odom and visual_odom/2."
    )
    assert stage.finding() == Finding(sentence, Severity.WARNING)


def test_lost_tracking_is_a_note_if_the_log_contains_poses():
    pose, stage = Pose(7, [1, 2, 3], [0, 0, 0, 1], "odom", "base_link"), Running(PoseFilter())
    for segment in (1, 2, 3):
        motion = motions(DRIVE.cameras(1), DRIVE.stamps(1), segment=segment)[0]
        stage(motion, Tilt(7, DRIVE.ups(1)[0]), mount_of(DRIVE), pose)
    assert stage.finding() == Finding("Visual odometry lost track 2 times. The poses are those of the log.")


def frozen(poses: list[Pose]) -> list[Pose]:
    return [replace(pose, position=poses[0].position) for pose in poses]


def askew(poses: list[Pose]) -> list[Pose]:
    by = Rotation.from_euler("z", 90, degrees=True)
    return [replace(pose, quaternion=(by * Rotation.from_quat(pose.quaternion)).as_quat()) for pose in poses]


def leaping(poses: list[Pose]) -> list[Pose]:
    return [replace(pose, position=pose.position + (5.0 if number > 9 else 0.0)) for number, pose in enumerate(poses)]


def slipping(poses: list[Pose]) -> list[Pose]:
    return [replace(pose, position=1.1 * pose.position) for pose in poses]


def dragging(poses: list[Pose]) -> list[Pose]:
    return [replace(pose, position=pose.position / 1.1) for pose in poses]


@pytest.mark.parametrize("based", [True, False])
@pytest.mark.parametrize(("change", "sentence"), [
    (lambda poses: poses, None),
    (slipping, None),
    (dragging, r"are 10 % longer than those of the logged odometry \(\d\d steps\), which slip does not explain"),
    (frozen, r"disagrees with visual odometry: median step 0\.0\d m vs 0\.\d\d m"),
    (askew, "disagrees with visual odometry"),
    (leaping, r"jumps 1 time relative to visual odometry, by up to 8\.\d m"),
])  # fmt: skip
def test_a_logged_pose_that_disagrees_with_the_images_is_a_warning(change, sentence, based):
    stage, mount = Running(PoseFilter()), mount_of(DRIVE, based)
    poses = change(located(DRIVE, Running(PoseFilter()), based))
    given = motions(DRIVE.cameras(), DRIVE.stamps())
    for motion, up, pose in zip(given, DRIVE.ups(), poses, strict=True):
        assert stage(motion, Tilt(motion.stamp, up), mount, pose) is pose
    found = stage.finding()
    assert (found is None) == (sentence is None)
    if found is not None and sentence is not None:
        assert re.search(sentence, found.sentence)
        assert found.severity == Severity.WARNING


def test_without_base_link_the_pose_is_that_of_the_camera():
    poses = located(DRIVE, Running(PoseFilter()), based=False)
    assert poses[0].child_frame_id == DRIVE.truth.mounts[0].child
    first, last = (DRIVE.cameras()[frame].translation for frame in (0, -1))
    assert abs(np.linalg.norm(poses[-1].position) - np.linalg.norm(last - first)) < 0.05
    axis = Rotation.from_quat(poses[0].quaternion).as_matrix()[:, 2]
    assert abs(axis[1]) < 1e-9  # the optical axis is the heading


def test_a_frame_without_motion_is_refused():
    motion = replace(
        motions(DRIVE.cameras(1), DRIVE.stamps(1))[0], camera=None, lost="only 3 features have a disparity"
    )
    with pytest.raises(ValueError, match="no pose from the images: only 3 features have a disparity"):
        Running(PoseFilter())(motion, Tilt(0, DRIVE.ups(1)[0]), mount_of(DRIVE))
