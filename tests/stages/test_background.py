"""The background fill: equal to its plain reference, and never wider than the evidence."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.kernels.background import fill_background, fill_background_reference


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 6), st.integers(1, 40), st.sampled_from([0.0, 2.0, 10.0, np.inf]), st.integers(0, 2**31))
def test_the_fill_equals_its_reference_and_keeps_what_was_known(height, width, reach, seed):
    rng = np.random.default_rng(seed)
    disparity = rng.uniform(0, 30, (height, width)).astype(np.float32)
    disparity[rng.random((height, width)) < 0.6] = np.nan
    filled = fill_background(disparity, reach)
    assert np.array_equal(filled, fill_background_reference(disparity, reach), equal_nan=True)
    known = np.isfinite(disparity)
    assert np.array_equal(filled[known], disparity[known])


def test_a_hole_takes_its_background_and_only_if_the_step_explains_it():
    row = np.full((1, 60), np.nan, np.float32)
    row[0, 10:20] = 5
    row[0, 40:50] = 25
    filled = fill_background(row, reach=0)
    assert (filled[0, 20:40] == 5).all()
    assert np.isnan(filled[0, :10]).all()
    assert np.isnan(filled[0, 50:]).all()
    row[0, 40:50] = 24
    assert np.isnan(fill_background(row, reach=0)[0, 20:40]).all()
