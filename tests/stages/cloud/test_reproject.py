"""Reproject places every known pixel with its depth sigma, and makes no point of an unknown one."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from stages.cloud.kernels.triangulation import SIGMA_BEST, SIGMA_WORST, triangulate, triangulate_reference
from stages.cloud.reproject import Reproject
from stages.data import Disparity, PixelOrigin, StereoCamera, StereoFrame
from tests.stages.builders import disparity_of
from tests.stages.terrain.terrain_scene import CAMERA, FRAME, as_disparity, blank_frame, rocks_seen

SMALL = StereoCamera(100.0, 110.0, 7.5, 5.25, 0.2, 16, 12, cx_right=9.0)


def test_points_project_back_to_their_pixels_and_disparities():
    cloud = Reproject()(FRAME, as_disparity(rocks_seen()))
    x, y, z = cloud.points.T.astype(np.float64)
    v, u = np.divmod(cloud.pixel, CAMERA.width)
    assert len(cloud.points) > 200_000
    np.testing.assert_allclose(x / z * CAMERA.fx + CAMERA.cx, u, atol=1e-3)
    np.testing.assert_allclose(y / z * CAMERA.fy + CAMERA.cy, v, atol=1e-3)
    np.testing.assert_allclose(CAMERA.fx * CAMERA.baseline / z, rocks_seen()[v, u], rtol=1e-6)
    assert (cloud.frame_id, cloud.shape, cloud.stamp, cloud.sensor) == (CAMERA.frame_id, (480, 640), 7, None)


def test_triangulation_kernel_equals_the_reference():
    random = np.random.default_rng(1)
    pixels = random.uniform(-4, 20, (12, 16)).astype(np.float32)
    pixels[random.random(pixels.shape) < 0.2] = np.nan
    pixels[0, :3] = np.inf, -np.inf, -1.5
    source = random.integers(0, 4, pixels.shape).astype(np.uint8)
    confidence = random.uniform(-0.1, 1.1, pixels.shape).astype(np.float32)
    confidence[0, 5] = np.nan
    own = np.where(random.random(pixels.shape) < 0.5, np.float32(0.2), np.float32(np.nan))
    colours = random.integers(0, 256, (12, 16, 3), np.uint8)
    variants = product((colours, colours[..., 0].copy()), (False, True), (0.0, 0.04), (None, own))
    for image, filled, spacing, sigma in variants:
        arguments = (Disparity(0, pixels, source, confidence, sigma=sigma), image, SMALL, 8.0, filled, spacing)
        for got, want in zip(triangulate(*arguments), triangulate_reference(*arguments), strict=True):
            assert got.dtype == want.dtype
            np.testing.assert_allclose(got, want, rtol=1e-6)


def test_filled_pixels_become_points_on_request_and_planes_always():
    codes = PixelOrigin.MEASURED, PixelOrigin.PLANE, PixelOrigin.FILLED, PixelOrigin.UNKNOWN
    frame = blank_frame(StereoCamera(100.0, 100.0, 2.0, 0.5, 0.2, 4, 1))
    disparity = disparity_of(np.full((1, 4), 5), codes, stamp=7)
    assert Reproject()(frame, disparity).pixel.tolist() == [0, 1]
    cloud = Reproject(include_filled=True)(frame, disparity)
    assert cloud.pixel.tolist() == [0, 1, 2]
    assert cloud.sigma == pytest.approx(np.array([0.086, 0.75, 3.0]) * 4.0**2 / (100 * 0.2))
    assert cloud.source.tolist() == list(codes[:3])


def test_depth_sigma_predicts_the_scatter_of_noisy_disparities():
    camera = StereoCamera(969.0, 969.0, 320.0, 240.0, 0.24, 640, 480)
    d = 30 + np.random.default_rng(2).normal(0, 0.25, (480, 640))
    disparity = replace(as_disparity(d, camera), sigma=np.full(d.shape, 0.25, np.float32))
    cloud = Reproject()(blank_frame(camera), disparity)
    assert cloud.points[:, 2].std() == pytest.approx(cloud.sigma.mean(), rel=0.02)


def test_depth_sigma_grows_geometrically_as_confidence_falls():
    camera = StereoCamera(100.0, 100.0, 2.0, 0.5, 0.2, 5, 1)
    disparity = disparity_of(np.full((1, 5), 5), confidence=np.linspace(1, 0, 5), stamp=7)
    sigma = Reproject()(blank_frame(camera), disparity).sigma
    assert sigma / sigma[0] == pytest.approx((SIGMA_WORST / SIGMA_BEST) ** np.linspace(0, 1, 5), rel=1e-5)


def test_a_match_without_its_own_sigma_gets_that_of_its_confidence():
    camera = StereoCamera(100.0, 100.0, 2.0, 0.5, 0.2, 2, 1)
    own, disparity = np.float32([[0.3, np.nan]]), disparity_of([[5, 5]], stamp=7)
    sigma = [Reproject()(blank_frame(camera), each).sigma for each in (replace(disparity, sigma=own), disparity)]
    assert sigma[0] == pytest.approx([0.3 * 5**2 / 25 * 0.8, sigma[1][1]], rel=1e-5)


def test_points_beyond_max_depth_are_left_out_and_a_cloud_may_be_empty():
    near = Reproject(max_depth=5.0)(FRAME, as_disparity(rocks_seen()))
    assert 4.9 < near.points[:, 2].max() <= 5.0
    none = Reproject()(FRAME, as_disparity(np.full((480, 640), np.nan)))
    assert none.points.shape == (0, 3)
    assert none.pixel.shape == none.sigma.shape == (0,)


def test_near_points_are_thinned_as_far_as_their_spacing_allows():
    disparity = as_disparity(rocks_seen())
    every, some = (Reproject(max_spacing=spacing)(FRAME, disparity) for spacing in (0.0, 0.02))
    assert 0.05 < len(some.points) / len(every.points) < 0.7
    assert np.isin(some.pixel, every.pixel).all()
    across = every.points[:, 2] / CAMERA.fx  # between neighbours
    rows, columns = (np.select([4 * across <= most, 2 * across <= most], [4, 2], 1) for most in (0.02, 0.04))
    row, column = np.divmod(every.pixel, CAMERA.width)
    kept = (row % rows == 0) & (column % columns == 0)
    assert (np.isin(every.pixel, some.pixel) == kept).mean() > 0.9999


@pytest.mark.parametrize(("fx", "fy", "rows"), [(400.0, 100.0, 1), (100.0, 400.0, 4)])
def test_rows_of_pixels_that_are_not_square_are_thinned_by_their_own_spacing(fx, fy, rows):
    camera = StereoCamera(fx, fy, 20.0, 15.0, 0.2, 40, 30)
    disparity = disparity_of(np.full((30, 40), fx * camera.baseline / 4.0), stamp=7)  # 4 m away
    cloud = Reproject(max_spacing=0.05)(blank_frame(camera), disparity)
    assert np.diff(np.unique(cloud.pixel // 40)).tolist() == [rows] * (29 // rows)


def test_colours_come_from_the_left_image():
    left, right = np.random.default_rng(3).integers(0, 256, (2, 12, 16, 3), np.uint8)
    disparity = as_disparity(np.full((12, 16), 5.0), SMALL)
    cloud = Reproject()(StereoFrame(7, left, right, SMALL), disparity)
    np.testing.assert_array_equal(cloud.colors, left.reshape(-1, 3))
    gray = Reproject()(StereoFrame(7, left[..., 0], right[..., 0], SMALL), disparity)
    np.testing.assert_array_equal(gray.colors, np.repeat(left[..., 0].reshape(-1, 1), 3, axis=1))


@pytest.mark.parametrize("bits", [10, 12, 16])
def test_deep_images_give_the_colours_of_their_eight_bit_twin(bits):
    camera = StereoCamera(100.0, 100.0, 32.0, 24.0, 0.2, 64, 48)
    eight = np.random.default_rng(4).integers(0, 256, (48, 64, 3)).astype(np.uint8)
    deep = eight.astype(np.uint16) << (bits - 8)
    cloud = Reproject()(StereoFrame(7, deep, deep, camera), as_disparity(np.full((48, 64), 5.0), camera))
    assert np.abs(cloud.colors.astype(int) - eight.reshape(-1, 3)).max() <= 2


def test_depth_is_by_the_camera_of_the_disparity_or_else_of_the_frame():
    other = replace(SMALL, baseline=0.4, frame_id="other")
    pixels = np.full((12, 16), 3.5)
    cloud = Reproject()(blank_frame(SMALL), as_disparity(pixels, other))
    assert cloud.points[:, 2] == pytest.approx(100.0 * 0.4 / (3.5 + 1.5))
    assert cloud.frame_id == "other"
    without = replace(as_disparity(pixels, other), camera=None)
    assert Reproject()(blank_frame(SMALL), without).points[:, 2] == pytest.approx(100.0 * 0.2 / (3.5 + 1.5))
