"""Level makes any cloud upright, for any attitude of the rover and any mounting of its sensors."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stages.cloud.kernels.rigid import transform_points, transform_points_reference
from stages.cloud.level import Level, level_transform
from stages.data import LEVEL_FRAME, Mount, PixelOrigin, Tilt, Transform
from tests.stages import builders
from tests.stages.terrain.terrain_scene import HEIGHT, LEVEL_FROM_CAMERA, UP

BARE = Mount(0, np.eye(3))
# Optical axes in base axes: x right is -y, y down is -z, z forward is x.
BASE_FROM_OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
rotations = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1).map(
    lambda q: Rotation.from_quat(q).as_matrix()
)  # fmt: skip


def cloud_of(points, frame_id="camera"):
    return builders.cloud_of(points, frame_id=frame_id, shape=(1, max(len(points), 1)))


POINTS = np.random.default_rng(0).uniform(-4, 4, (200, 3)) + np.array([0, 0, 5])
CLOUD = cloud_of(POINTS)


def test_ground_below_a_pitched_camera_is_level_at_height_zero():
    ground = np.column_stack([np.random.default_rng(1).uniform((1, -5), (11, 5), (500, 2)), np.zeros(500)])
    seen = (ground - [0, 0, HEIGHT]) @ LEVEL_FROM_CAMERA
    cloud = Level(camera_height=HEIGHT)(cloud_of(seen), Tilt(3, UP), BARE)
    np.testing.assert_allclose(cloud.points, ground, atol=2e-6)
    assert (cloud.frame_id, cloud.sensor.parent, cloud.sensor.child) == (LEVEL_FRAME, LEVEL_FRAME, "camera")
    np.testing.assert_allclose(cloud.sensor.translation, [0, 0, HEIGHT], atol=1e-12)
    np.testing.assert_allclose(cloud.sensor(seen), ground, atol=1e-12)


@given(turn=rotations)
def test_the_level_transform_is_a_rotation_that_maps_up_to_z(turn):
    up = turn @ UP
    assume(abs(up[2]) < 0.98)
    transform = level_transform(Tilt(0, up), BARE, "camera")
    np.testing.assert_allclose(transform.rotation @ up, [0, 0, 1], atol=1e-9)
    axis = transform.rotation @ [0, 0, 1]
    assert axis[0] > 0
    assert axis[1] == pytest.approx(0, abs=1e-9)
    assert np.linalg.det(transform.rotation) == pytest.approx(1)


@given(turn=rotations)
def test_the_orientation_of_the_inclinometer_does_not_matter(turn):
    level, turned = Level()(CLOUD, Tilt(0, UP), BARE), Level()(CLOUD, Tilt(0, turn.T @ UP), Mount(0, turn))
    np.testing.assert_allclose(turned.points, level.points, atol=1e-5)


@given(turn=rotations)
def test_with_base_link_the_camera_orientation_does_not_matter(turn):
    up_in_base, clouds = Rotation.from_euler("xyz", [0.2, -0.3, 0]).apply([0, 0, 1]), []
    for by in (np.eye(3), turn):
        base_from_camera = Transform("base_link", "camera", BASE_FROM_OPTICAL @ by, np.array([0.3, 0.12, 0.9]))
        mount = Mount(0, base_from_camera.rotation.T, base_from_camera)
        clouds.append(Level()(cloud_of(POINTS @ by), Tilt(0, up_in_base), mount))
    np.testing.assert_allclose(clouds[1].points, clouds[0].points, atol=1e-5)


def test_the_level_frame_has_the_origin_and_heading_of_base_link():
    aside = Rotation.from_euler("z", 30, degrees=True).as_matrix() @ BASE_FROM_OPTICAL
    base_from_camera = Transform("base_link", "camera", aside, np.array([0.5, -0.1, 1.2]))
    transform = level_transform(Tilt(0, np.array([0, -1.0, 0])), Mount(0, np.eye(3), base_from_camera), "camera", 99.0)
    np.testing.assert_allclose(transform.translation, [0.5, -0.1, 1.2], atol=1e-12)
    np.testing.assert_allclose(transform.rotation, aside, atol=1e-12)


def test_a_point_on_the_axis_of_a_nose_up_camera_is_above_it():
    a = np.deg2rad(10)
    up = np.array([0, -np.cos(a), np.sin(a)])
    cloud = Level(camera_height=0)(cloud_of(np.array([[0, 0, 8.0]])), Tilt(0, up), BARE)
    np.testing.assert_allclose(cloud.points[0], [8 * np.cos(a), 0, 8 * np.sin(a)], atol=1e-6)


def test_only_a_tilt_in_the_frame_of_the_camera_needs_no_mount():
    cloud = cloud_of(POINTS, "left_optical")
    alone = Level()(cloud, Tilt(0, UP, "left_optical"))
    np.testing.assert_array_equal(alone.points, Level()(cloud, Tilt(0, UP), BARE).points)
    with pytest.raises(ValueError, match=r"tilt is in frame 'inclinometer', the cloud in 'left_optical'.*port 'mount'"):
        Level()(cloud, Tilt(0, UP))


FILLED = replace(CLOUD, source=np.full(len(POINTS), PixelOrigin.FILLED, np.uint8))


@pytest.mark.parametrize(("cloud", "up", "message"), [
    (CLOUD, [0, 0, -1.0], "nearly vertical"),
    (CLOUD, [0, -0.08, -np.sqrt(1 - 0.08**2)], "nearly vertical"),
    (Level()(CLOUD, Tilt(0, UP), BARE), UP, "only once"),
    (cloud_of(np.zeros((0, 3))), UP, "the frame has no measured point within range"),
    (FILLED, UP, "the frame has no measured point within range"),
])  # fmt: skip
def test_clouds_that_cannot_be_levelled_are_refused(cloud, up, message):
    with pytest.raises(ValueError, match=message):
        Level()(cloud, Tilt(0, np.array(up)), BARE)


def test_level_changes_only_the_points():
    level = Level()(CLOUD, Tilt(0, UP), BARE)
    for name in ("stamp", "shape", "colors", "sigma", "pixel"):
        np.testing.assert_array_equal(getattr(level, name), getattr(CLOUD, name))


def test_transform_kernel_equals_the_reference():
    arguments = (CLOUD.points, LEVEL_FROM_CAMERA, np.array([1.0, 2.0, 3.0]))
    got, want = transform_points(*arguments), transform_points_reference(*arguments)
    np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-6)


def test_the_cloud_carries_the_sigma_of_the_tilt():
    assert Level(tilt_sigma=0.01)(CLOUD, Tilt(3, UP), BARE).tilt_sigma == 0.01
    assert Level(tilt_sigma=0.01)(CLOUD, Tilt(3, UP, sigma=0.002), BARE).tilt_sigma == 0.002
    assert CLOUD.tilt_sigma == 0
    with pytest.raises(ValueError, match="tilt_sigma"):
        Level(tilt_sigma=-0.01)
