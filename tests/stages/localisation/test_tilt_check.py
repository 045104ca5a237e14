"""CheckTilt judges the tilt by the frames in which the rover moved, and by the slope of the ground in view."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flow.contracts import Severity
from stages import CheckTilt, Mount, PointCloud, Tilt, TiltHealth, Transform
from stages.data import Array
from tests.stages.builders import cloud_of
from tests.stages.localisation.drive import FRAMES, Drive, misread, motions, readings
from tests.stages.running import Running
from tests.tilt_faults import flipped

DRIVE = Drive(2, 8.0)
MOUNT = Mount(0, DRIVE.mount)
# Motion, tilt and mount of a rover that stands with a level camera.
STANDING = motions(DRIVE.cameras(1), [0])[0], Tilt(0, np.array([0, -1.0, 0]), "camera"), Mount(0, np.eye(3))


def checked(ups: Array, stage: Running, repeats: int = 1) -> list[TiltHealth]:
    return [stage(*reading, MOUNT) for reading in readings(DRIVE, ups) for _ in range(repeats)]


def ground(slope: float, rocks: int = 0) -> PointCloud:
    """Ground in view of a camera that looks along it from 1 m, sloping up ahead by so many degrees."""
    rng = np.random.default_rng(0)
    x, z = rng.uniform(-3, 3, 9000), rng.uniform(1, 10, 9000)
    points = np.column_stack([x, np.ones_like(x), z]) + rng.normal(0, 0.01, (9000, 3))
    points[:rocks, 1] -= rng.uniform(0.1, 0.5, rocks)
    points = points @ Rotation.from_euler("x", slope, degrees=True).as_matrix().T
    return cloud_of(points, frame_id="camera")


def test_a_sound_tilt_is_reported_as_sound():
    stage = Running(CheckTilt())
    found = checked(DRIVE.ups(), stage)
    assert found[0].judgement == "No frames to judge the tilt by."
    assert np.isnan(found[0].turn)
    assert 0.05 < np.degrees(np.sqrt(np.nanmean(np.square([health.turn for health in found])))) < 0.4
    assert found[-1].frames == FRAMES
    assert {health.fault for health in found} == {""}
    assert stage.finding().sentence.startswith("Tilt and camera agree to 0.")
    assert stage.finding().severity is Severity.NOTE


def test_a_flipped_sign_is_found_within_30_frames_and_reported_at_the_end():
    stage = Running(CheckTilt())
    found = checked(np.array([flipped(0)(up) for up in DRIVE.ups()]), stage)
    first = next(count for count, health in enumerate(found) if health.fault)
    assert first < 30
    assert "The sign of pitch is flipped" in stage.finding().sentence
    assert stage.finding().severity is Severity.FAULT
    assert stage.finding() == stage.finding()  # asking changes nothing


@pytest.mark.parametrize(("filtered", "remedy"), [(False, "source.pitch.sign"), (True, "of the gyroscope")])
def test_an_estimated_tilt_has_a_remedy_of_its_own(filtered, remedy):
    flip, stage = flipped(0), Running(CheckTilt())
    for motion, tilt in readings(DRIVE):
        stage(motion, Tilt(motion.stamp, flip(tilt.up), sigma=0.003, filtered=filtered), MOUNT)
    assert remedy in stage.finding().sentence


@pytest.mark.parametrize("sigma", [None, 0.003, 0.01, np.pi / 2])
@pytest.mark.parametrize("order", [[0, 2, 1, 3], [1, 0, 2, 3], [0, 3, 2, 1]])
def test_a_large_mount_error_that_few_frames_show_and_more_contradict_is_not_reported(order, sigma):
    drive, stage, named = Drive(1, 4.0), Running(CheckTilt()), []
    for motion, tilt in readings(drive, misread(drive, order, [1, 1, 1, 1], 0.7).ups):
        named.append(stage(motion, replace(tilt, sigma=sigma), Mount(0, drive.mount)).fault)
    assert named[-1] == "inconsistent"
    assert "no remedy is known" in stage.finding().sentence


@pytest.mark.parametrize("sigma", [None, 0.003, np.pi / 2])
def test_a_large_mount_error_is_reported_at_any_stated_sigma(sigma):
    turned, stage = Rotation.from_euler("z", 40, degrees=True).as_matrix(), Running(CheckTilt())
    noisy = Drive(2, 8.0, noise=1.2)
    for motion, tilt in readings(noisy):
        stage(motion, replace(tilt, sigma=sigma), Mount(0, noisy.mount @ turned))
    assert re.match(r"The mount of the inclinometer is wrong by (39|40)\.", stage.finding().sentence)


@pytest.mark.parametrize(("late", "fault"), [(0, ""), (5, "the mount of the inclinometer is wrong")])
def test_a_camera_that_pans_is_judged_by_its_mount_in_each_frame(late, fault):
    """late: frames by which the mounts lag behind the pan; at 0.2 rad a frame the camera is then elsewhere."""
    pans = [Rotation.from_euler("y", np.sin(0.3 * count)).as_matrix() for count in range(-late, FRAMES)]
    cameras = [
        Transform(camera.parent, camera.child, camera.rotation @ pan, camera.translation)
        for camera, pan in zip(DRIVE.cameras(), pans[late:], strict=True)
    ]
    stage = Running(CheckTilt())
    for motion, up, pan in zip(motions(cameras, DRIVE.stamps()), DRIVE.ups(), pans, strict=False):
        stage(motion, Tilt(motion.stamp, up), Mount(motion.stamp, pan.T @ DRIVE.mount))
    finding = stage.finding()
    if fault:
        assert finding.severity is Severity.FAULT
    else:
        assert finding.sentence.startswith("Tilt and camera agree to 0.")


def test_frames_of_a_standing_rover_are_not_kept():
    moving, halting = Running(CheckTilt()), Running(CheckTilt())
    checked(DRIVE.ups(), moving)
    assert checked(DRIVE.ups(), halting, repeats=4)[-1].frames == FRAMES
    assert halting.finding() == moving.finding()


def test_repeated_stamps_hide_no_fault():
    flip, stage = flipped(0), Running(CheckTilt())
    for motion, tilt in readings(DRIVE):
        stamp = motion.stamp // 10**9 * 10**9  # a clock of whole seconds
        stage(replace(motion, stamp=stamp), Tilt(stamp, flip(tilt.up)), MOUNT)
    assert "The sign of pitch is flipped" in stage.finding().sentence


def test_a_fault_that_ends_halfway_is_reported_at_the_end():
    ups = DRIVE.ups()
    ups[:25] = [flipped(0)(up) for up in ups[:25]]
    stage = Running(CheckTilt(window=20))
    checked(ups, stage)
    assert "The sign of pitch is flipped" in stage.finding().sentence
    assert "judgements)" in stage.finding().sentence


def test_the_slope_of_the_ground_ignores_rocks_and_the_frame_of_the_cloud():
    sensor = Transform("level", "camera", Rotation.from_euler("y", 40, degrees=True).as_matrix(), np.ones(3))
    for slope in (0.0, 8.0, -15.0):
        cloud = ground(slope, rocks=1500)
        gaps = cloud.points.copy()
        gaps[::50, 0] = np.nan
        moved, gappy = cloud_of(sensor(cloud.points), sensor=sensor), replace(cloud, points=gaps)
        plain, other, holed = (Running(CheckTilt())(*STANDING, each).ground for each in (cloud, moved, gappy))
        assert abs(np.degrees(plain) - abs(slope)) < 0.5
        assert [other, holed] == pytest.approx([plain] * 2, abs=1e-3)


@pytest.mark.parametrize("frames", [1, 2, 4, 12])
def test_ground_far_off_level_in_every_frame_is_a_warning(frames):
    """For example: the sign of pitch is wrong and the camera looks down by 14.6 degrees."""
    stage = Running(CheckTilt())
    for _ in range(frames):
        assert stage(*STANDING, ground(29.2)).fault == "up is off the ground"
    found = stage.finding()
    assert found.severity is Severity.WARNING
    assert re.search(r"off level by 29\.\d degrees or more in (the only|every)", found.sentence), found.sentence
    assert "Check the unit and the sign of pitch, the inclinometer's axes and its mount" in found.sentence


def test_steep_ground_in_only_some_frames_is_no_fault():
    for slopes in ((15.0, 15.0), (-15.0,), (29.0, 18.0)):
        stage = Running(CheckTilt())
        *_, health = (stage(*STANDING, ground(slope)) for slope in slopes)
        assert (health.fault, stage.finding().severity) == ("", Severity.NOTE)


def test_motion_proves_a_tilt_sound_on_a_hillside_of_25_degrees():
    stage, hill = Running(CheckTilt()), ground(25.0)
    for motion, tilt in readings(DRIVE):
        level = Rotation.align_vectors([DRIVE.mount @ tilt.up], [[0, -1.0, 0]])[0].as_matrix()
        stage(motion, tilt, MOUNT, replace(hill, points=(hill.points @ level.T).astype(np.float32)))
    assert stage.finding().severity is Severity.NOTE
    assert stage.finding().sentence.startswith("Tilt and camera agree to 0.")


@pytest.mark.parametrize("count", [9000, 0])
def test_a_ball_and_an_empty_cloud_have_no_ground(count):
    points = np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 5], (count, 3))
    assert np.isnan(Running(CheckTilt())(*STANDING, cloud_of(points, frame_id="camera")).ground)
