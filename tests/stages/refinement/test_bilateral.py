"""The joint bilateral filter: equal to its plain reference, and true to edges."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.refinement.kernels.bilateral import joint_bilateral, joint_bilateral_reference


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 30), st.integers(1, 30), st.integers(1, 5), st.integers(0, 2**31), st.booleans())
def test_the_filter_equals_its_reference(height, width, radius, seed, plain):
    rng = np.random.default_rng(seed)
    disparity = rng.uniform(0, 30, (height, width)).astype(np.float32)
    disparity[rng.random((height, width)) < 0.3] = np.nan
    guide = rng.integers(0, 256, (height, width), dtype=np.uint8)
    reference = joint_bilateral_reference(disparity, guide, radius, plain)
    assert joint_bilateral(disparity, guide, radius, plain=plain) == pytest.approx(reference, abs=1e-4, nan_ok=True)


def test_texture_does_not_move_ground_that_is_seen_at_a_slant():
    rng = np.random.default_rng(0)
    row, column = np.mgrid[:60, :80]
    ground = (20 + 0.25 * row - 0.1 * column).astype(np.float32)
    guide = rng.integers(60, 120, ground.shape, dtype=np.uint8)
    off, off_in_paper = (
        np.abs(joint_bilateral(ground, guide, 3, plain=plain) - ground)[8:-8, 8:-8] for plain in (False, True)
    )
    assert off.max() < 0.001
    assert off_in_paper.mean() > 0.03


def test_a_step_and_what_is_unknown_beside_it_stay():
    step = np.full((40, 60), 10, np.float32)
    step[:, 30:] = 14
    step[:, 28:30] = np.nan
    filtered = joint_bilateral(step, np.full(step.shape, 100, np.uint8), 3)
    assert filtered == pytest.approx(
        np.where(np.isnan(step), np.nan, np.where(step < 12, 10, 14)), abs=0.1, nan_ok=True
    )
