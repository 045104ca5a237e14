"""Level makes any cloud upright, for any attitude of the rover and any mounting of its sensors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stages.cloud.kernels.rigid import transform_points, transform_points_reference
from stages.cloud.level import Level, level_transform
from stages.data import LEVEL_FRAME, Array, Mount, PixelOrigin, PointCloud, Tilt, Transform
from tests.stages.terrain.terrain_scene import HEIGHT, UP, level_from_camera

BARE = Mount(0, np.eye(3))
# Optical axes in base axes: x right is -y, y down is -z, z forward is x.
BASE_FROM_OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
rotations = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1).map(
    lambda q: Rotation.from_quat(q).as_matrix()
)  # fmt: skip


def cloud_of(points: Array, frame_id: str = "camera") -> PointCloud:
    n = len(points)
    return PointCloud(
        3, points.astype(np.float32), np.zeros((n, 3), np.uint8), np.ones(n, np.float32), np.arange(n, dtype=np.int32),
        frame_id, (1, max(n, 1)),
    )  # fmt: skip


def scattered(n: int = 200) -> Array:
    return np.random.default_rng(0).uniform(-4, 4, (n, 3)) + np.array([0, 0, 5])


def test_ground_below_a_pitched_camera_is_level_at_height_zero() -> None:
    ground = np.column_stack([np.random.default_rng(1).uniform((1, -5), (11, 5), (500, 2)), np.zeros(500)])
    seen = (ground - [0, 0, HEIGHT]) @ level_from_camera()
    cloud = Level(camera_height=HEIGHT)(cloud_of(seen), Tilt(3, UP), BARE)
    np.testing.assert_allclose(cloud.points, ground, atol=2e-6)
    assert cloud.frame_id == LEVEL_FRAME
    assert cloud.sensor is not None
    assert (cloud.sensor.parent, cloud.sensor.child) == (LEVEL_FRAME, "camera")
    np.testing.assert_allclose(cloud.sensor.translation, [0, 0, HEIGHT], atol=1e-12)
    np.testing.assert_allclose(cloud.sensor(seen), ground, atol=1e-12)


@given(turn=rotations)
def test_the_level_transform_is_a_rotation_that_maps_up_to_z(turn: Array) -> None:
    up = turn @ UP
    assume(abs(up[2]) < 0.98)
    transform = level_transform(Tilt(0, up), BARE, "camera")
    np.testing.assert_allclose(transform.rotation @ up, [0, 0, 1], atol=1e-9)
    axis = transform.rotation @ [0, 0, 1]
    assert axis[0] > 0
    assert axis[1] == pytest.approx(0, abs=1e-9)
    assert np.linalg.det(transform.rotation) == pytest.approx(1)


@given(turn=rotations)
def test_the_orientation_of_the_inclinometer_does_not_matter(turn: Array) -> None:
    level = Level()(cloud_of(scattered()), Tilt(0, UP), BARE)
    turned = Level()(cloud_of(scattered()), Tilt(0, turn.T @ UP), Mount(0, turn))
    np.testing.assert_allclose(turned.points, level.points, atol=1e-5)


@given(turn=rotations)
def test_with_base_link_the_camera_orientation_does_not_matter(turn: Array) -> None:
    points, place = scattered(), np.array([0.3, 0.12, 0.9])
    up_in_base = Rotation.from_euler("xyz", [0.2, -0.3, 0]).apply([0, 0, 1])

    def levelled(base_from_camera: Array, seen: Array) -> PointCloud:
        mount = Mount(0, base_from_camera.T, Transform("base_link", "camera", base_from_camera, place))
        return Level()(cloud_of(seen), Tilt(0, up_in_base), mount)

    usual = levelled(BASE_FROM_OPTICAL, points)
    turned = levelled(BASE_FROM_OPTICAL @ turn, points @ turn)
    np.testing.assert_allclose(turned.points, usual.points, atol=1e-5)


def test_the_level_frame_has_the_origin_and_heading_of_base_link() -> None:
    aside = Rotation.from_euler("z", 30, degrees=True).as_matrix() @ BASE_FROM_OPTICAL
    base_from_camera = Transform("base_link", "camera", aside, np.array([0.5, -0.1, 1.2]))
    transform = level_transform(Tilt(0, np.array([0, -1.0, 0])), Mount(0, np.eye(3), base_from_camera), "camera", 99.0)
    np.testing.assert_allclose(transform.translation, [0.5, -0.1, 1.2], atol=1e-12)
    np.testing.assert_allclose(transform.rotation, aside, atol=1e-12)


def test_a_point_on_the_axis_of_a_nose_up_camera_is_above_it() -> None:
    a = np.deg2rad(10)
    up = np.array([0, -np.cos(a), np.sin(a)])
    cloud = Level(camera_height=0)(cloud_of(np.array([[0, 0, 8.0]])), Tilt(0, up), BARE)
    np.testing.assert_allclose(cloud.points[0], [8 * np.cos(a), 0, 8 * np.sin(a)], atol=1e-6)


def test_only_a_tilt_in_the_frame_of_the_camera_needs_no_mount() -> None:
    cloud = cloud_of(scattered(), "left_optical")
    alone = Level()(cloud, Tilt(0, UP, "left_optical"))
    np.testing.assert_array_equal(alone.points, Level()(cloud, Tilt(0, UP), BARE).points)
    with pytest.raises(ValueError, match=r"tilt is in frame 'inclinometer', the cloud in 'left_optical'.*port 'mount'"):
        Level()(cloud, Tilt(0, UP))


def test_vertical_headings_and_levelled_clouds_are_refused() -> None:
    with pytest.raises(ValueError, match="nearly vertical"):
        level_transform(Tilt(0, np.array([0, 0, -1.0])), BARE, "camera")
    once = Level()(cloud_of(scattered()), Tilt(0, UP), BARE)
    with pytest.raises(ValueError, match="only once"):
        Level()(once, Tilt(0, UP), BARE)


def test_level_changes_only_the_points() -> None:
    cloud = cloud_of(scattered())
    level = Level()(cloud, Tilt(0, UP), BARE)
    for name in ("colors", "sigma", "pixel"):
        np.testing.assert_array_equal(getattr(level, name), getattr(cloud, name))
    assert (level.stamp, level.shape) == (cloud.stamp, cloud.shape)


@pytest.mark.parametrize("points", [np.zeros((0, 3)), scattered()])
def test_a_frame_without_measured_points_is_refused(points: Array) -> None:
    cloud = replace(cloud_of(points), source=np.full(len(points), PixelOrigin.FILLED, np.uint8))
    with pytest.raises(ValueError, match="the frame has no measured point within range"):
        Level()(cloud, Tilt(0, UP), BARE)


def test_transform_kernel_equals_the_reference() -> None:
    cloud = replace(cloud_of(scattered()), frame_id="camera")
    arguments = (cloud.points, level_from_camera(), np.array([1.0, 2.0, 3.0]))
    got, want = transform_points(*arguments), transform_points_reference(*arguments)
    np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-6)


def test_the_cloud_carries_the_sigma_of_the_tilt() -> None:
    cloud = cloud_of(scattered())
    assert Level(tilt_sigma=0.01)(cloud, Tilt(3, UP), BARE).tilt_sigma == 0.01
    assert Level(tilt_sigma=0.01)(cloud, Tilt(3, UP, sigma=0.002), BARE).tilt_sigma == 0.002
    assert cloud.tilt_sigma == 0
    with pytest.raises(ValueError, match="tilt_sigma"):
        Level(tilt_sigma=-0.01)
