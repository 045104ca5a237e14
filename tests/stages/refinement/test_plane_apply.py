"""Trusted matches, medians and applied planes equal plain references."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from stages.data import PixelOrigin
from stages.refinement.kernels import plane_apply as kernel
from stages.refinement.kernels.valid_extent import extent


def scene(height, width, seed):
    rng = np.random.default_rng(seed)
    pixels = rng.uniform(2, 14, (height, width)).astype(np.float32)
    pixels[rng.random((height, width)) < 0.5] = np.nan
    labels = rng.integers(0, 4, (height, width), dtype=np.int32)
    coefficients = rng.uniform([-0.1, -0.1, 3], [0.1, 0.1, 12], (4, 3))
    coefficients[2] = np.nan
    return pixels, coefficients, labels


@given(st.integers(1, 20), st.integers(1, 30), st.booleans(), st.sampled_from([0, 3]), st.integers(0, 2**31))
def test_planes_pull_and_fill_as_in_the_reference(height, width, fill, margin, seed):
    pixels, coefficients, labels = scene(height, width, seed)
    within = extent(pixels)
    given = pixels, coefficients, labels, within, 2.0, 0.7, fill, margin
    (pulled, applied), (expected, expected_applied) = (
        kernel.pull_to_planes(*given),
        kernel.pull_to_planes_reference(*given),
    )
    assert np.allclose(pulled, expected, atol=1e-5, equal_nan=True)
    assert np.array_equal(applied, expected_applied)


@given(st.integers(1, 24), st.integers(1, 30), st.sampled_from([3, 5]), st.sampled_from([0.0, 1.5, 1000.0]),
       st.integers(0, 2**31))  # fmt: skip
def test_the_median_equals_that_of_sorted_windows(height, width, side, near, seed):
    pixels, *_ = scene(height, width, seed)
    moved = kernel.near_median(pixels, side, near)
    assert np.array_equal(moved, kernel.near_median_reference(pixels, side, near), equal_nan=True)


@given(st.integers(1, 20), st.integers(1, 30), st.integers(0, 2**31))
def test_trusted_matches_equal_the_reference(height, width, seed):
    pixels, *_ = scene(height, width, seed)
    rng = np.random.default_rng(seed)
    source = rng.integers(0, len(PixelOrigin), pixels.shape, dtype=np.uint8)
    confidence = rng.choice(np.array([0.2, 0.5, 0.7], np.float32), pixels.shape)
    saturated = rng.random(pixels.shape) < 0.1
    given = pixels, source, confidence, 0.5, saturated
    np.testing.assert_equal(tuple(kernel.trusted_matches(*given)), tuple(kernel.trusted_matches_reference(*given)))


def test_a_dropped_match_has_a_reason_and_unknown_pixels_keep_theirs():
    codes = PixelOrigin.MEASURED, PixelOrigin.MEASURED, PixelOrigin.MEASURED, PixelOrigin.PLANE, PixelOrigin.SPECKLE
    pixels = np.array([[3, 9, 3, 3, np.nan]], np.float32)
    confidence = np.array([[0.9, 0.9, 0.4, 0.9, 0]], np.float32)
    saturated = np.array([[True, False, False, False, True]])
    _, _, reasons = kernel.trusted_matches(pixels, np.array([codes], np.uint8), confidence, 0.5, saturated)
    assert [PixelOrigin(code).name for code in reasons[0]] == ["SKY", "OUT_OF_VIEW", "UNIQUENESS", "UNKNOWN", "SPECKLE"]
