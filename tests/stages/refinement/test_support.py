"""Support that follows texture: kernels equal their references; ground is smoothed, rocks are kept."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.compiled.parallel import shared_by
from stages.matching.image_noise import noise_levels
from stages.matching.kernels.texture import FLOOR, gradient, information_scale
from stages.refinement.kernels import blocks as kernel
from stages.refinement.kernels.support import _add_bend, _blend, add_bend_reference, blend_reference, supported

ALONE = shared_by(1)


def case(height, width, seed):
    """Sloping disparities with noise, holes and guesses, and images."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width]
    pixels = (9 + 0.05 * x + 0.1 * y + rng.normal(0, 0.3, (height, width))).astype(np.float32)
    pixels[rng.random(pixels.shape) < 0.1] = np.nan
    images = [rng.integers(0, 256, (height, width), np.uint8) for _ in range(2)]
    return pixels, rng.random(pixels.shape) < 0.2, images, rng.uniform(0.5, 3, 256).astype(np.float32)


def support(matches, images, guessed=False, threads=1):
    """The matches of two images, supported by these."""
    left, right = images
    guessed = np.broadcast_to(guessed, matches.shape).copy()
    return supported(matches, guessed, left, (gradient(left), gradient(right)), noise_levels(left), FLOOR, threads)


@given(st.integers(1, 40), st.integers(1, 50), st.integers(0, 2**31), st.sampled_from([1, 2]))
def test_sums_of_both_sizes_equal_the_reference(height, width, seed, threads):
    pixels, guessed, (left, right), noise = case(height, width, seed)
    slopes, scale = (gradient(left), gradient(right)), information_scale(noise)
    small = kernel.block_sums(pixels, guessed, left, slopes, scale, 3, shared_by(threads))
    large, _ = kernel.coarser(small, np.zeros((kernel.PLANE_LAYERS, *small.shape[1:]), np.float32), 4)
    for blocks, size in ((small, 4), (large, 8)):
        expected = kernel.block_sums_reference(pixels, guessed, left, slopes, scale, size)
        _, rows, cols = expected.shape
        for layer in range(kernel.BLOCK_LAYERS):
            tolerance = 1e-3 * max(1.0, float(np.abs(expected[layer]).max()))
            assert np.allclose(blocks[layer, :rows, :cols], expected[layer], atol=tolerance), layer
            assert not blocks[layer, rows:].any()


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**31))
def test_planes_equal_least_squares_over_the_matches_of_the_window(seed):
    pixels, guessed, (left, right), noise = case(32, 48, seed)
    slopes = gradient(left), gradient(right)
    blocks = kernel.block_sums(pixels, guessed, left, slopes, information_scale(noise), 3, ALONE)
    blocks[kernel.VARIANCE] = np.random.default_rng(seed).uniform(0.01, 0.3, blocks.shape[1:])
    start = np.zeros((3, *blocks.shape[1:]), np.float32)
    start[kernel.A], start[kernel.B], start[kernel.C] = 0.04, 0.12, blocks[kernel.MEAN] + 0.1
    found = kernel.fit_windows(blocks, start, 4, ALONE)
    y, x = np.nonzero(np.isfinite(pixels) & ~guessed)
    for j, i in ((0, 0), (3, 5), (7, 11)):
        within = (abs(y // 4 - j) <= 2) & (abs(x // 4 - i) <= 2)
        across, down = x[within] - 4 * i - 1.5, y[within] - 4 * j - 1.5
        numbers = (y // 4 * blocks.shape[2] + x // 4)[within]
        points = np.stack([across, down, pixels[y, x][within], numbers], axis=1).astype(np.float64)
        first = start[:, j, i].astype(np.float64)
        plane, residual = kernel.fit_window_reference(points, first, blocks[kernel.VARIANCE].ravel().astype(np.float64))
        assert np.allclose(found[:3, j, i], plane, atol=2e-3)
        assert found[kernel.RESIDUAL, j, i] == pytest.approx(residual, rel=0.02, abs=1e-3)


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 13), st.integers(1, 17), st.integers(0, 2**31))
def test_the_last_step_equals_the_reference(height, width, seed):
    rng = np.random.default_rng(seed)
    pixels, guessed, _, _ = case(height, width, seed)
    shape = 4, 8  # blocks
    planes = rng.uniform(0, 0.3, (kernel.PLANE_LAYERS, *shape)).astype(np.float32)
    planes[kernel.C] += 10
    planes[kernel.WEIGHT, rng.random(shape) < 0.2] = 0
    matches = rng.integers(0, 17, shape).astype(np.float32)
    variance, spread, near = (rng.uniform(0.01, 0.5, shape).astype(np.float32) for _ in range(3))
    given = pixels, guessed, matches, planes, variance, spread, near, rng.integers(0, height + 1, width)
    result = [np.empty(pixels.shape, np.float32) for _ in range(3)]
    _blend(*given, 0, height, *result)
    for layer, expected in zip(result, blend_reference(*given), strict=True):
        assert np.allclose(layer, expected, rtol=1e-4, atol=1e-4, equal_nan=True)


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 13), st.integers(1, 17), st.integers(0, 2**31))
def test_bends_equal_the_reference(height, width, seed):
    pixels, _, _, _ = case(height, width, seed)
    sigma = np.random.default_rng(seed).uniform(0.05, 0.5, pixels.shape).astype(np.float32)
    expected = add_bend_reference(pixels, sigma)
    _add_bend(pixels, 0, height, sigma)
    assert np.allclose(sigma, expected, rtol=1e-4, atol=1e-5)


def views(contrast, disparity, seed=0, noise=1.5):
    """A pair of noisy images of ground with texture of a contrast, gray levels, at a disparity (H, W)."""
    height, width = disparity.shape
    rng = np.random.default_rng(seed)
    texture = cv2.GaussianBlur(rng.standard_normal((height, width + 80)), (0, 0), 1.5)
    right = 120 + contrast * texture / texture.std()
    x = np.arange(width, dtype=np.float32)[None] - disparity.astype(np.float32) + 40
    rows = np.broadcast_to(np.arange(height, dtype=np.float32)[:, None], x.shape)
    left = cv2.remap(right.astype(np.float32), x, np.ascontiguousarray(rows), cv2.INTER_LINEAR)
    pair = left, right[:, 40 : 40 + width]
    noisy = (image + noise * rng.standard_normal(image.shape) for image in pair)
    return [np.clip(np.rint(image), 0, 255).astype(np.uint8) for image in noisy]


def ground(noise, seed=5):
    """True disparities of sloping ground with a step of 3 px, and noisy matches of it."""
    y, x = np.mgrid[:160, :240]
    truth = 8 + 0.05 * y + 3.0 * ((abs(y - 80) < 12) & (abs(x - 120) < 12))
    errors = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal(truth.shape), (0, 0), 2)
    return truth, (truth + noise * errors / errors.std()).astype(np.float32)


AWAY = np.ones((160, 240), bool)  # from the step
AWAY[60:101, 100:141] = False


def rms(errors):
    return float(np.sqrt(np.mean(np.square(errors))))


def test_weak_texture_gets_planes_and_strong_texture_keeps_its_matches():
    truth, matches = ground(noise=0.4)
    weak = support(matches, views(2.0, truth))
    assert rms((weak.pixels - truth)[AWAY]) < 0.4 * rms((matches - truth)[AWAY])
    truth, matches = ground(noise=0.05)
    relief = (matches + 0.3 * np.sin(np.arange(240) / 3)).astype(np.float32)
    strong = support(relief, views(30.0, relief))
    assert rms((strong.pixels - relief)[AWAY]) < 0.05


def test_a_small_rock_on_weak_texture_keeps_its_height():
    truth, matches = ground(noise=0.4)
    found = support(matches, views(2.0, truth)).pixels
    assert np.median((found - truth)[72:89, 112:129]) == pytest.approx(0, abs=0.3)
    assert rms((found - truth)[40:60, 100:140]) < 0.25


def test_sigma_contains_the_errors_it_states():
    truth, matches = ground(noise=0.4)
    for contrast in (1.0, 2.0):
        found = support(matches, views(contrast, truth))
        assert np.mean(abs(found.pixels - truth)[AWAY] < 2 * found.sigma[AWAY]) > 0.8


def test_matches_of_noise_have_no_correlation_and_a_large_sigma():
    images = np.rint(np.random.default_rng(1).normal(120, 1.5, (2, 160, 240))).astype(np.uint8)
    _, matches = ground(noise=0.4)
    found = support(matches, images)
    assert np.mean((found.correlation > 0.4) & (found.sigma < 0.5)) < 0.02


def test_a_guess_is_evidence_only_where_matches_share_its_block():
    truth, matches = ground(noise=0.1)
    guessed = np.zeros(truth.shape, bool)
    guessed[20:40, 20:40] = guessed[100:103, 60] = True
    found = support(matches, views(8.0, truth), guessed)
    assert np.all(found.sigma[20:40, 20:40] > 100)
    assert np.all(found.sigma[100:103, 60] < 0.5)


def test_threads_do_not_change_the_result():
    truth, matches = ground(noise=0.4)
    one, two = (support(matches, views(2.0, truth), threads=threads) for threads in (1, 2))
    np.testing.assert_equal(tuple(one), tuple(two))
