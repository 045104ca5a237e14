"""Frames are aligned to the regional map, refused where they do not fit, and reset it if that continues."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flow.contracts import Severity
from stages import Fuse, Pose, Transform
from stages.terrain.map_registration import register
from tests.conftest import slow
from tests.stages.running import Running
from tests.stages.terrain.region_scene import MOUNT, START, centres, drive, flat, fused, rolling


def heights(cloud, placed):
    """Mean height in each cell of the square of 20 m about the origin, NaN where there is none."""
    points = placed(cloud.points)
    cells = (np.floor(points[:, :2] / 0.05).astype(int) + 200) @ (1, 400)
    with np.errstate(invalid="ignore"):
        return np.bincount(cells, points[:, 2], 160_000) / np.bincount(cells, minlength=160_000)


def test_frames_with_tilt_errors_join_without_a_seam():
    rng, fuse, seams, before = np.random.default_rng(3), Running(Fuse()), [], None
    for frame in range(12):
        cloud, pose = drive(frame, tilt=tuple(rng.normal(0, np.radians(0.4), 2)), noise=0.01)
        places = register(Fuse(), cloud, pose, MOUNT)[0], fuse(cloud, pose, MOUNT).level
        now = [heights(cloud, placed) for placed in places]
        if before is not None:
            off = [one - other for one, other in zip(before, now, strict=True)]
            seams.append([1.4826 * np.nanmedian(np.abs(values - np.nanmedian(values))) for values in off])
        before = now
    raw, joined = np.median(seams, axis=0)
    assert raw > 0.015
    assert joined < 0.007  # 1 cm of noise in 6 points a cell, twice, is 0.6 cm
    assert np.max(seams, axis=0)[1] < 0.008


def leans_of_the_map(covariance, frames=61):
    """Lean of the map that each frame is placed in, over the error of the first tilt; and the last map."""
    fuse, lean, found = Running(Fuse()), np.radians(0.6), []
    for frame in range(frames):
        at = (0.25 * frame, 0.0, 0.0)
        cloud, pose = drive(frame, flat, tilt=(0.0 if frame else lean, 0.0), at=at, points=10_000)
        terrain = fuse(cloud, replace(pose, covariance=covariance), MOUNT)
        found.append(np.arcsin(terrain.level.rotation[2, 0]) / lean)
    return np.array(found), terrain


def test_the_tilt_error_of_the_first_frame_fades_if_the_pose_is_uncertain():
    found, terrain = leans_of_the_map(np.diag([1e-4] * 3 + [3e-3] * 2 + [1e-3]))
    assert 0.7 < found[1] < 1.0  # aligned to the map
    assert abs(found[40]) < 0.15
    assert abs(found[60]) < 0.1
    assert min(found) > -0.1
    assert abs(terrain.level.translation[2]) < 0.1


@pytest.mark.parametrize("frames", [15, *slow(61)])
@pytest.mark.parametrize("covariance", [None, np.diag([1e-6] * 3 + [1e-7] * 3)])
def test_the_tilt_error_of_a_frame_does_not_tilt_the_map_of_a_precise_pose(covariance, frames):
    found, terrain = leans_of_the_map(covariance, frames)
    assert np.abs(found[1:]).max() < 0.1
    assert np.nanmax(np.abs(terrain.layers["elevation"])) < 0.01


def test_a_map_of_noisy_tilts_and_exact_poses_is_level_and_at_the_true_height():
    tilts, fuse = np.radians(0.2) * np.random.default_rng(3).normal(size=(50, 2)), Running(Fuse())
    for frame, tilt in enumerate(tilts):
        cloud, pose = drive(frame, tilt=tuple(tilt), at=(0.3 * frame, 0.0, 0.0), points=5_000)
        terrain = fuse(replace(cloud, tilt_sigma=np.radians(0.2)), pose, MOUNT)
    x, y = centres(terrain)
    error = terrain.layers["elevation"] - rolling(x, y)
    known = np.isfinite(error)
    design = np.column_stack([x[known], y[known], np.ones(known.sum())])
    slopes = np.linalg.lstsq(design, error[known], rcond=None)[0][:2]
    assert np.degrees(np.hypot(*slopes)) < 0.05
    for place in range(6, 22, 2):
        assert abs(np.median(error[known & (np.abs(x - place) < 1)])) < 0.01


def test_a_pose_of_the_camera_gives_the_map_of_a_pose_of_the_rover():
    cloud, pose = drive(3)
    base = Transform("odom", "base_link", Rotation.from_quat(pose.quaternion).as_matrix(), pose.position)
    camera = base.after(MOUNT.base_from_camera)
    turn = Rotation.from_matrix(camera.rotation).as_quat()
    one = Running(Fuse())(cloud, pose, MOUNT)
    other = Running(Fuse())(cloud, Pose(pose.stamp, camera.translation, turn, "odom", "camera"))
    np.testing.assert_allclose(one.level.translation, other.level.translation, atol=1e-9)
    np.testing.assert_allclose(one.layers["elevation"], other.layers["elevation"], atol=1e-5)


def test_roll_and_pitch_of_the_pose_do_not_tilt_the_map():
    cloud, pose = drive(3)
    tilted = Rotation.from_quat(pose.quaternion) * Rotation.from_euler("yx", [8, -5], degrees=True)
    level = Transform("level", "base_link", Rotation.from_euler("yx", [8, -5], degrees=True).as_matrix(), np.zeros(3))
    cloud = replace(cloud, sensor=level.after(MOUNT.base_from_camera))
    placed, _ = register(Fuse(), cloud, replace(pose, quaternion=tilted.as_quat()), MOUNT)
    np.testing.assert_allclose(placed.rotation, Rotation.from_quat(pose.quaternion).as_matrix(), atol=1e-9)
    np.testing.assert_allclose(placed.translation, pose.position, atol=1e-9)


def leant(pose, degrees):
    """The pose in a frame that leans by this."""
    lean = Rotation.from_euler("x", degrees, degrees=True)
    turned = (lean * Rotation.from_quat(pose.quaternion)).as_quat()
    return replace(pose, position=lean.as_matrix() @ pose.position, quaternion=turned)


def raised(pose, up):
    return replace(pose, position=pose.position + np.array([0, 0, up]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda cloud, pose: (replace(cloud, frame_id="camera", sensor=None), pose), "put stages.Level before it"),
        (lambda cloud, pose: (replace(cloud, sensor=None), pose), "lacks its camera's pose"),
        (lambda cloud, pose: (cloud, replace(pose, child_frame_id="mast")), "the pose is of 'mast', and no transform"),
        (lambda cloud, pose: (cloud, leant(pose, 180)), "180 degrees off the vertical .* whose z points up"),
        (lambda cloud, pose: (replace(cloud, stamp=START), pose), "is not later than the last one"),
    ],
)  # fmt: skip
def test_a_frame_that_cannot_be_registered_does_not_change_the_map(change, message):
    fuse, _ = fused([drive(0)])
    before = fuse.state.cells.read(-300, -300, 600, 600)
    with pytest.raises(ValueError, match=message):
        fuse(*change(*drive(1)), MOUNT)
    np.testing.assert_array_equal(fuse.state.cells.read(-300, -300, 600, 600), before)


@pytest.mark.parametrize(("degrees", "warned"), [(0, False), (4, False), (6, True), (12, True)])
def test_a_pose_in_a_frame_that_leans_is_a_warning(degrees, warned):
    frames = (drive(frame) for frame in range(4))
    fuse, _ = fused((cloud, leant(pose, degrees)) for cloud, pose in frames)
    found = fuse.finding()
    assert (found is not None) == warned
    if found:
        assert f"'odom' is {degrees} degrees off the vertical" in found.sentence
        assert found.severity == "warning"


@pytest.mark.parametrize("restarts", [False, True])
def test_a_pose_without_roll_and_pitch_may_drive_on_a_slope(restarts):
    """restarts: the frame of the pose is another one before, in which the pose had a roll."""
    frames = [sloping(*drive(frame)) for frame in range(1, 4)]
    before, pose = drive(0)
    first = (before, replace(leant(pose, 12), frame_id="map")) if restarts else sloping(before, pose)
    fuse, _ = fused([first, *frames])
    assert fuse.finding() is None


def sloping(cloud, pose):
    """A cloud whose camera is tilted, with a pose that only has a heading."""
    slope = Rotation.from_euler("x", 12, degrees=True).as_matrix()
    heading = Rotation.from_euler("z", Rotation.from_quat(pose.quaternion).as_euler("ZYX")[0]).as_quat()
    sensor = replace(cloud.sensor, rotation=slope @ cloud.sensor.rotation)
    return replace(cloud, sensor=sensor), replace(pose, quaternion=heading)


def test_a_refused_frame_does_not_count_as_leaning():
    fuse, _ = fused(drive(frame) for frame in range(3))
    for frame in (3, 4):
        cloud, pose = drive(frame)
        with pytest.raises(ValueError, match="left out of the regional map"):
            fuse(cloud, raised(leant(pose, 29), 5.0), MOUNT)
    assert fuse.finding() is None


@pytest.mark.parametrize("up", [0.6, -0.4, 1e6, *slow(30.0, -1e3)])
def test_a_pose_that_jumps_is_refused_and_the_third_time_resets_the_map(up):
    fuse, terrain = fused(drive(frame) for frame in range(5))
    for frame in (5, 6):
        cloud, pose = drive(frame)
        with pytest.raises(ValueError, match=r"m and 0\.0 degrees off the map, .* left out of the regional map"):
            fuse(cloud, raised(pose, up), MOUNT)
    again = fuse(*drive(7), MOUNT)  # the map goes on
    assert fuse.finding() is None
    assert again.layers["frames"].max() > terrain.layers["frames"].max()
    for frame in (8, 9, 10):
        cloud, pose = drive(frame)
        given = cloud, raised(pose, up), MOUNT
        try:
            fresh = fuse(*given)
        except ValueError:
            assert frame < 10
    np.testing.assert_equal(dict(fresh.layers), dict(Running(Fuse())(*given).layers))
    found = fuse.finding()
    assert found.severity is Severity.WARNING
    assert "The regional map was reset 1 time (frame odom)" in found.sentence


def leaning(frame, degrees):
    cloud, pose = drive(frame)
    turned = Rotation.from_euler("y", degrees, degrees=True).apply(cloud.points).astype(np.float32)
    return replace(cloud, points=turned), pose


@pytest.mark.parametrize(("sigmas", "degrees"), [
    ({"tilt_sigma": 0.05}, (0, 3, -4, 5, -3, 4)), ({"height_sigma": 0.002}, (0.0, 0.4, -0.3, 0.5, -0.4, 0.3)),
])  # fmt: skip
def test_a_change_within_the_stated_height_and_tilt_errors_is_no_jump(sigmas, degrees):
    fuse, terrain = fused((leaning(frame, angle) for frame, angle in enumerate(degrees)), **sigmas)
    assert terrain.layers["frames"].max() == len(degrees)
    assert fuse.finding() is None


def test_a_tilt_that_jumps_is_refused_with_its_degrees():
    fuse, _ = fused(drive(frame) for frame in range(3))
    with pytest.raises(ValueError, match=r"and [3-6]\.\d degrees off the map"):
        fuse(*leaning(3, 6), MOUNT)


def test_a_pose_in_another_frame_resets_the_map():
    cloud, pose = drive(1)
    lost = cloud, replace(pose, frame_id="visual_odom/2")
    (_, begun), (_, expected) = fused([drive(0), lost]), fused([lost])
    assert begun.frame_id == "visual_odom/2"
    np.testing.assert_equal(dict(begun.layers), dict(expected.layers))
