"""Holes: what is hidden takes its background, what was not matched its line, and what nothing explains stays open."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.kernels.holes import KEPT, MISMATCH, OCCLUSION, OPEN, Extent, extent, fill_holes, fill_holes_reference

EVERYWHERE = Extent(np.zeros(100, np.int64), np.zeros(1, np.int64), np.full(1, 99))  # the sky is elsewhere


def random_disparity(height, width, seed):
    rng = np.random.default_rng(seed)
    disparity = rng.uniform(0, 12, (height, width)).astype(np.float32)
    disparity[rng.random((height, width)) < rng.uniform(0.3, 0.95)] = np.nan
    return disparity


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 12), st.integers(1, 40), st.sampled_from([0.0, 4.0, 64.0]), st.sampled_from([0.0, 3.0, 16.0]),
       st.integers(0, 2**31), st.sampled_from([1, 2]))  # fmt: skip
def test_the_fill_equals_its_reference(height, width, reach, margin, seed, threads):
    disparity = random_disparity(height, width, seed)
    within = extent(disparity)
    known = np.isfinite(disparity)
    assert np.array_equal(within.top, np.where(known.any(axis=0), known.argmax(axis=0), height))
    filled, kinds = fill_holes(disparity, within, reach, margin, threads)
    expected, expected_kinds = fill_holes_reference(disparity, within, reach, margin)
    assert np.allclose(filled, expected, atol=1e-4, equal_nan=True)
    assert np.array_equal(kinds, expected_kinds)


def row_of(left, right, hole):
    disparity = np.full((1, 100), np.nan, np.float32)
    disparity[0, :30], disparity[0, 30 + hole :] = left, right
    return disparity


def test_between_two_surfaces_the_farther_one_is_hidden():
    filled, kinds = fill_holes(row_of(5, 25, 20), EVERYWHERE, reach=0, margin=0)
    assert (filled[0, 30:50] == 5).all()
    assert (kinds[0, 30:50] == OCCLUSION).all()
    assert (kinds[0, :30] == KEPT).all()
    wider, kinds = fill_holes(row_of(5, 25, 21), EVERYWHERE, reach=0, margin=0)
    assert np.isnan(wider[0, 30:51]).all()
    assert (kinds[0, 30:51] == OPEN).all()


def test_on_one_surface_the_line_is_drawn():
    filled, kinds = fill_holes(row_of(10, 11, 9), EVERYWHERE, reach=16, margin=0)
    assert np.allclose(filled[0, 29:40], np.linspace(10, 11, 11))
    assert (kinds[0, 30:39] == MISMATCH).all()
