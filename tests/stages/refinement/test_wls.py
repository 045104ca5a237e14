"""WLS: equal to the sparse solve, keeps constants, stops at edges of the guide."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.refinement.kernels.wls import MIN_WEIGHT, smooth, smooth_reference


@settings(max_examples=15, deadline=None)
@given(
    st.integers(1, 24), st.integers(1, 24), st.sampled_from([0.5, 30.0, 8000.0]), st.sampled_from([1.0, 3e-6]),
    st.integers(0, 2**31),
)  # fmt: skip
def test_equals_a_sparse_solve_of_every_line(height, width, strength, heaviest, seed):
    rng = np.random.default_rng(seed)
    values = rng.uniform(0, 100, (height, width)).astype(np.float32)
    weights = np.where(rng.random((height, width)) < 0.3, 0, rng.random((height, width))).astype(np.float32)
    weights[0, 0] = 1
    weights *= np.float32(heaviest)  # the lighter ones are close to the smallest that has an effect
    guide = rng.integers(100, 110, (height, width), dtype=np.uint8)
    smoothed = smooth(values, weights, guide, strength, 3.0)
    expected, mass = smooth_reference(values, weights, guide, strength, 3.0)
    reached = mass > 1.001 * MIN_WEIGHT
    assert smoothed[reached] == pytest.approx(expected[reached], rel=1e-4, abs=1e-4)
    assert np.isnan(smoothed[mass < 0.999 * MIN_WEIGHT]).all()


def test_a_hole_takes_the_value_on_its_side_of_the_edge():
    guide = np.full((40, 60), 50, np.uint8)
    guide[:, 30:] = 200
    values = np.where(guide == 50, 10, 90).astype(np.float32)
    weights = np.ones_like(values)
    weights[10:20, 20:40] = 0
    values[10:20, 20:40] = np.nan
    smoothed = smooth(values, weights, guide, 8000, 1)
    assert np.allclose(smoothed, np.where(guide == 50, 10, 90), atol=0.01)


def test_where_no_weight_reaches_the_value_is_unknown():
    guide = np.zeros((20, 20), np.uint8)
    guide[:, 10:] = 255
    weights = np.zeros((20, 20), np.float32)
    weights[:, :10] = 1
    smoothed = smooth(np.ones((20, 20), np.float32), weights, guide, 10, 1)
    assert np.isnan(smoothed[:, 10:]).all()
    assert np.allclose(smoothed[:, :10], 1)
