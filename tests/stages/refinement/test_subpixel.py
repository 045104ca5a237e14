"""Subpixel fractions from brightness: equal to the plain reference, and without the bias of matching."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages import Match, Refine, StereoCamera, StereoFrame
from stages.refinement.kernels.subpixel import MAX_SHIFT, fit_brightness, fit_brightness_reference

HEIGHT, WIDTH = 120, 260


def shifted(disparity, seed=0, noise=1.0):
    """A textured surface of these disparities, a number or (H, W), px: its left and its right image, uint8."""
    rng = np.random.default_rng(seed)
    texture = cv2.GaussianBlur(rng.normal(0, 1, (4 * HEIGHT, 4 * WIDTH)).astype(np.float32), (0, 0), 5)
    texture = 128 + 40 * texture / texture.std()
    x, y = (grid.astype(np.float32) for grid in np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)))
    views = (cv2.remap(texture, 4 * at, 4 * y, cv2.INTER_CUBIC) for at in (np.float32(x - disparity), x))
    return [np.clip(np.rint(view + rng.normal(0, noise, view.shape)), 0, 255).astype(np.uint8) for view in views]


@given(st.integers(1, 30), st.integers(1, 150), st.integers(1, 4), st.sampled_from([1, 2]), st.integers(0, 2**31))
def test_the_fit_equals_its_reference(height, width, radius, threads, seed):
    rng = np.random.default_rng(seed)
    left = cv2.blur(rng.integers(0, 256, (height, width), np.uint8), (3, 3))
    right = np.roll(left, -4, axis=1)
    disparity = rng.choice([3.7, 4.0, 4.4, 9.3], left.shape).astype(np.float32) + rng.random(left.shape, np.float32)
    disparity[rng.random(left.shape) < 0.2] = np.nan
    found = fit_brightness(left, right, disparity, radius, threads)
    np.testing.assert_allclose(found, fit_brightness_reference(left, right, disparity, radius), rtol=0, atol=1e-3)
    np.testing.assert_array_equal(found, fit_brightness(left, right, disparity, radius))


@pytest.mark.parametrize("fraction", [0.2, 0.4, 0.6, 0.8])
def test_a_surface_facing_the_camera_is_not_biased_to_whole_pixels(fraction):
    true = 20 + fraction
    left, right = shifted(true)
    frame = StereoFrame(0, left, right, StereoCamera(500, 500, WIDTH / 2, HEIGHT / 2, 0.2, WIDTH, HEIGHT))
    matched = Match(disparities=48)(frame)
    refined, unfitted = (Refine(subpixel_radius=radius)(frame, matched) for radius in (2, 0))
    inner = np.s_[10:-10, 60:-10]
    off = [float(np.median(each.pixels[inner])) - true for each in (refined, unfitted)]
    assert abs(off[0]) < 0.05
    assert abs(off[1]) > 0.1


def test_a_common_offset_on_a_slope_is_corrected():
    true = 20 + 0.2 * np.arange(HEIGHT)[:, None] + np.zeros((1, WIDTH))
    left, right = shifted(true)
    moved = fit_brightness(left, right, (true + 0.2).astype(np.float32), 2)
    assert np.abs(moved - true)[10:-10, 60:-10].mean() < 0.05


def test_pixels_behind_a_depth_edge_do_not_move_those_in_front():
    true = np.where(np.arange(WIDTH) < 140, 12.0, 30.0) + np.zeros((HEIGHT, 1))
    left, right = shifted(true, noise=0)
    moved = fit_brightness(left, right, true.astype(np.float32), 2)
    np.testing.assert_allclose(moved[:, 141:-10], 30, atol=0.05)


def test_a_match_without_contrast_or_partner_stays():
    even = np.full((HEIGHT, WIDTH), 90, np.uint8)
    disparity = np.full(even.shape, 7.25, np.float32)
    np.testing.assert_array_equal(fit_brightness(even, even, disparity, 2), disparity)
    left, right = shifted(7.0)
    moved = fit_brightness(left, right, disparity, 2)
    np.testing.assert_array_equal(moved[:, :8], disparity[:, :8])
    assert np.abs(moved - disparity).max() <= MAX_SHIFT + 1e-5
    assert np.isnan(fit_brightness(left, right, np.full(even.shape, np.nan, np.float32), 2)).all()
