"""Correlation: high where both images show the same, low where noise matches noise; equal to the plain reference."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.refinement.kernels.correlation import correlation, correlation_reference


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 40), st.integers(1, 50), st.integers(0, 2**31), st.sampled_from([1, 2]))
def test_the_correlation_equals_its_reference(height, width, seed, threads):
    rng = np.random.default_rng(seed)
    disparity = rng.uniform(-3, 12, (height, width)).astype(np.float32)
    disparity[rng.random(disparity.shape) < 0.3] = np.nan
    left, right = rng.choice(np.array([0, 90, 100, 110, 255], np.uint8), (2, height, width))
    guessed = rng.random(disparity.shape) < 0.1
    found = correlation(disparity, guessed, left, right, threads)
    np.testing.assert_array_equal(found, correlation_reference(disparity, guessed, left, right))
    assert np.abs(found).max() <= 1.000001


def test_sums_over_a_wide_row_of_full_contrast_are_exact():
    rng = np.random.default_rng(2)
    left = rng.choice(np.array([0, 255], np.uint8), (3, 4000))
    disparity, none = np.full(left.shape, 1.5, np.float32), np.zeros(left.shape, bool)
    np.testing.assert_array_equal(
        correlation(disparity, none, left, left), correlation_reference(disparity, none, left, left)
    )


def test_common_texture_correlates_and_noise_does_not():
    rng = np.random.default_rng(3)
    texture = rng.normal(0, 8, (120, 220))
    noise = rng.normal(0, 2, (2, 120, 200))
    left, right = texture[:, :200] + noise[0], texture[:, 10:210] + noise[1]  # a disparity of 10 px
    left[:60], right[:60] = noise[0, :60], noise[1, :60]  # the sky
    left, right = (np.clip(np.rint(image + 120), 0, 255).astype(np.uint8) for image in (left, right))
    found = correlation(np.full(left.shape, 10.0, np.float32), np.zeros(left.shape, bool), left, right)
    assert found[70:110, 20:190].min() > 0.8
    assert np.abs(found[:52]).max() < 0.5


def test_an_edge_along_the_row_does_not_correlate():
    rng = np.random.default_rng(4)
    left, right = rng.normal(0, 1, (2, 60, 100))
    for image in (left, right):
        image[30:] += 100
    left, right = (np.clip(np.rint(image + 60), 0, 255).astype(np.uint8) for image in (left, right))
    found = correlation(np.full(left.shape, 4.0, np.float32), np.zeros(left.shape, bool), left, right)
    assert np.abs(found).max() < 0.6


def test_without_texture_or_disparity_the_correlation_is_zero():
    flat = np.full((40, 60), 90, np.uint8)
    none = np.zeros(flat.shape, bool)
    assert not correlation(np.zeros((40, 60), np.float32), none, flat, flat).any()
    textured = np.random.default_rng(5).integers(0, 255, (40, 60)).astype(np.uint8)
    assert not correlation(np.full((40, 60), np.nan, np.float32), none, textured, textured).any()
    assert not correlation(np.zeros((40, 60), np.float32), ~none, textured, textured).any()
