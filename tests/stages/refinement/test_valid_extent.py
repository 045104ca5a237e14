"""The valid extent equals its plain reference and ignores specks."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from stages.refinement.kernels.valid_extent import extent, extent_reference


@given(st.integers(1, 70), st.integers(1, 40), st.integers(0, 2**31))
def test_the_extent_equals_its_reference(height, width, seed):
    rng = np.random.default_rng(seed)
    known = rng.random((height, width)) < rng.uniform(0.02, 0.7)
    disparity = np.where(known, 5, np.nan).astype(np.float32)
    np.testing.assert_equal(tuple(extent(disparity)), tuple(extent_reference(disparity)))


def test_specks_in_the_sky_do_not_widen_the_extent():
    scene = np.full((60, 80), np.nan, np.float32)
    scene[40:] = 5
    scene[3:6, 10:14] = 1
    found = extent(scene)
    assert (found.top == 40).all()
    assert found.first[4] > found.last[4]
    sparse = np.where(np.arange(60 * 80).reshape(60, 80) % 7 == 0, scene, np.float32(np.nan))  # knows little anywhere
    assert (extent(sparse).top >= 40).all()
    assert (extent(sparse).top < 47).all()
