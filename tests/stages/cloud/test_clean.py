"""Clean removes gross errors at every range and keeps valid points."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.cloud.clean import Clean
from stages.cloud.kernels.depth_order import out_of_order, out_of_order_reference
from stages.cloud.kernels.outliers import supported, supported_reference
from stages.cloud.kernels.patches import connected_patches, connected_patches_reference
from stages.cloud.reproject import Reproject
from stages.data import LEVEL_FRAME, Array, PixelOrigin, PointCloud, Transform
from tests.stages.terrain.terrain_scene import CAMERA, FRAME, HEIGHT, LEVEL_FROM_CAMERA, as_disparity, rocks_seen

RINGS = ((0, 2), (2, 4), (4, 6), (6, 8))
ROCK = ((4.0, 0.0, 0.25),)


def cloud_with_noise(seed: int = 0, sigma: float = 0.25) -> PointCloud:
    noise = np.random.default_rng(seed).normal(0, sigma, (CAMERA.height, CAMERA.width))
    disparity = replace(as_disparity(rocks_seen() + noise), sigma=np.full(noise.shape, 0.25, np.float32))
    return Reproject(max_depth=50)(FRAME, disparity)


def kept(disparity: Array, **parameters: str) -> Array:
    """Whether each pixel (H, W) of these disparities has a point after `Clean`."""
    cleaned = Clean(**parameters)(Reproject()(FRAME, as_disparity(disparity)))
    return np.isin(np.arange(disparity.size), cleaned.pixel).reshape(disparity.shape)


def with_floaters(cloud: PointCloud, share: float, seed: int = 1) -> tuple[PointCloud, Array]:
    """The cloud with some points moved along their pixel rays by 0.5 m or more off the ground, and which ones."""
    random = np.random.default_rng(seed)
    floats = random.random(len(cloud.points)) < share
    factor = random.uniform(0.15, 0.6, len(cloud.points))
    height = cloud.points.astype(np.float64) @ LEVEL_FROM_CAMERA[2]
    floats &= (height < -0.6) & (np.abs(height) * (1 - factor) >= 0.5)
    points = cloud.points.copy()
    points[floats] *= factor[floats, None].astype(np.float32)
    return replace(cloud, points=points), floats


def horizontal_range(cloud: PointCloud) -> Array:
    return np.hypot(*(cloud.points @ LEVEL_FROM_CAMERA.T)[:, :2].T)


@pytest.mark.parametrize("noise", [0.0, 0.25])
def test_clean_finds_98_percent_of_floaters_and_keeps_99_5_of_valid_points(noise):
    clean = cloud_with_noise(sigma=noise)
    distance = horizontal_range(clean)
    cloud, floats = with_floaters(clean, 0.02)
    kept = np.isin(cloud.pixel, Clean()(cloud).pixel)
    assert floats.sum() > 1500
    assert (~kept[floats]).mean() >= 0.98
    for low, high in RINGS:
        ring = (distance >= low) & (distance < high) & ~floats
        assert ring.sum() > 5000
        assert (~kept[ring]).mean() <= 0.005


@pytest.mark.parametrize("stride", [2, 3, 4])
def test_a_subsampled_cloud_is_cleaned_as_well(stride):
    cloud, floats = with_floaters(cloud_with_noise(), 0.02)
    row, col = np.divmod(cloud.pixel, CAMERA.width)
    take = (row % stride == 0) & (col % stride == 0)
    thin = cloud.only(take)
    kept = np.isin(thin.pixel, Clean()(thin).pixel)
    inside = np.linalg.norm(thin.points, axis=1) < 9
    assert (~kept[floats[take]]).mean() >= 0.98
    assert (~kept[inside & ~floats[take]]).mean() <= 0.005


def test_a_speck_of_nine_pixels_is_dropped_and_a_rock_is_kept():
    d, rock = rocks_seen(ROCK), rocks_seen(ROCK) - rocks_seen(()) > 1.0
    d[300:303, 100:103] *= 2
    assert not kept(d)[range(300, 303), range(100, 103)].any()
    assert kept(d)[rock].mean() > 0.99


def test_an_isolated_patch_of_a_hundred_pixels_is_dropped(monkeypatch):
    d, patch = rocks_seen(), np.s_[300:308, 100:112]
    d[patch] *= 2
    assert not kept(d)[patch].any()
    monkeypatch.setattr("stages.cloud.clean.MIN_PATCH_SHARE", 0.0)
    assert kept(d)[patch].ravel()[20:70].any()


@pytest.mark.parametrize("origin", [PixelOrigin.PLANE, PixelOrigin.FILLED])
def test_filled_points_support_no_other_and_are_only_cropped(origin):
    d = rocks_seen()
    d[300:303, 100:103] *= 2
    disparity = as_disparity(d)
    source = disparity.source.copy()
    source[290:312, 90:112][source[290:312, 90:112] > 0] = origin
    source[300:303, 100:103] = PixelOrigin.MEASURED
    pixels = np.where(source == origin, np.float32(d[301, 101]), disparity.pixels)
    cloud = Reproject(include_filled=True)(FRAME, replace(disparity, pixels=pixels, source=source))
    clean = Clean()(cloud)
    assert 301 * 640 + 101 not in clean.pixel  # a speck, although all filled pixels around it agree
    assert (clean.source == origin).sum() == (cloud.source == origin).sum() > 400
    far = replace(disparity, pixels=np.where(source == origin, np.float32(12.0), pixels), source=source)
    assert (Clean()(Reproject(include_filled=True)(FRAME, far)).source == origin).sum() == 0


def test_patch_kernel_equals_scipy_connected_components():
    random = np.random.default_rng(7)
    inverse = random.integers(1, 4, (40, 50)).astype(np.float32)
    inverse[random.random(inverse.shape) < 0.4] = np.nan
    tolerance = random.uniform(0, 0.6, inverse.shape).astype(np.float32)
    got, want = connected_patches(inverse, tolerance, 0.2), connected_patches_reference(inverse, tolerance, 0.2)
    assert len(want[1]) > 8
    np.testing.assert_equal(tuple(got), tuple(want))


def test_depth_order_kernel_equals_the_reference():
    random = np.random.default_rng(8)
    coarse = random.uniform(0.1, 0.5, (10, 12)).repeat(5, 0).repeat(5, 1)
    inverse = (coarse + random.normal(0, 0.002, coarse.shape)).astype(np.float32)
    inverse[random.random(inverse.shape) < 0.3] = np.nan
    patch, sizes = connected_patches(inverse, np.full(inverse.shape, 0.01, np.float32), 0.001)
    got = out_of_order(inverse, patch, sizes)
    assert 0 < got.sum() < len(sizes)
    np.testing.assert_array_equal(got, out_of_order_reference(inverse, patch, sizes))


@pytest.mark.parametrize(
    ("wrong", "disparity"),
    [
        (np.s_[:60, 200:300], 45.0),
        (np.s_[:60, 200:300], 14.0),
        (np.s_[110:150, 200:400], 17.0),
        (np.s_[400:480, 100:500], 14.0),
    ],
    ids=["in the sky", "in the sky, nearly beyond the crop", "above far ground", "under the ground"],
)
def test_a_large_patch_in_the_sky_or_under_the_ground_is_dropped(wrong, disparity):
    d, rock = rocks_seen(ROCK), rocks_seen(ROCK) - rocks_seen(()) > 1.0
    d[wrong] = disparity
    assert not kept(d)[wrong].any()
    assert kept(d)[rock].mean() > 0.99


def test_a_rock_that_hangs_before_the_ground_stays():
    d, rock = rocks_seen(()), np.s_[250:290, 250:400]
    d[rock] = 1.3 * d[290].max()
    d[:250, 250:270] = np.nan  # above some of it nothing is known
    assert kept(d)[rock].mean() > 0.95


def test_support_kernel_equals_the_reference():
    cloud, _ = with_floaters(cloud_with_noise(5), 0.05)
    random = np.random.default_rng(6)
    some = random.random(len(cloud.points)) < 0.4
    arguments = cloud.points, cloud.sigma, cloud.pixel, np.flatnonzero(some), (480, 640), 9.0
    (got, inverse, _), want = supported(*arguments), supported_reference(*arguments)
    assert 0 < len(got) < some.sum()
    np.testing.assert_array_equal(np.flatnonzero(inverse > 0), np.sort(cloud.pixel[got]))
    assert len(np.setxor1d(got, want)) < 1e-5 * some.sum()


@settings(max_examples=10, deadline=None)
@given(scale=st.sampled_from([0.25, 0.5, 2.0, 4.0]))
def test_a_scaled_scene_with_a_scaled_baseline_keeps_the_same_points(scale):
    cloud, _ = with_floaters(cloud_with_noise(), 0.02)
    larger = replace(cloud, points=cloud.points * np.float32(scale), sigma=cloud.sigma * np.float32(scale))
    once, again = Clean(margin=0)(cloud), Clean(max_range=8 * scale, margin=0)(larger)
    np.testing.assert_array_equal(once.pixel, again.pixel)


def test_the_crop_is_a_ball_around_the_camera():
    cloud = cloud_with_noise()
    near = Clean(max_range=5.0, margin=0.5)(cloud)
    assert 5.4 < np.linalg.norm(near.points, axis=1).max() <= 5.5
    assert np.all(np.diff(near.pixel) > 0)
    assert np.isin(cloud.pixel[horizontal_range(cloud) < 5.0], near.pixel).mean() > 0.995


def test_knn_drops_points_far_from_all_others():
    d, part = np.full((480, 640), np.nan), np.s_[300:340, 300:380]
    d[part] = rocks_seen(())[part]
    d[320, 340] *= 0.6
    assert not kept(d, method="knn")[320, 340]
    assert kept(d, method="knn")[part].mean() > 0.95


@pytest.mark.parametrize("method", ["organised", "knn"])
def test_a_cloud_of_no_or_one_point_is_accepted(method):
    d = np.full((480, 640), np.nan)
    assert not kept(d, method=method).any()
    d[300, 300] = 40
    assert kept(d, method=method).sum() == (method == "knn")


def test_a_levelled_cloud_and_a_wrong_image_shape_are_refused():
    cloud = cloud_with_noise()
    sensor = Transform(LEVEL_FRAME, cloud.frame_id, LEVEL_FROM_CAMERA, np.array([0, 0, HEIGHT]))
    with pytest.raises(ValueError, match="precedes Level"):
        Clean()(replace(cloud, sensor=sensor, frame_id=LEVEL_FRAME))
    with pytest.raises(ValueError, match="method: knn"):
        Clean()(replace(cloud, shape=None))
    with pytest.raises(ValueError, match=r"outside an image of shape \(100, 100\)"):
        replace(cloud, shape=(100, 100))
    for shape in ((0, 100), (-1, 5), (10.0, 10), (10, 10, 10)):
        with pytest.raises(ValueError, match=r"must be \(rows, columns\)"):
            replace(cloud, shape=shape)
