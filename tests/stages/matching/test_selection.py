"""Selection: winners, checks and patches are, bit for bit, those of the references, whichever way they are found."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import njit

from stages.compiled.parallel import shared_by
from stages.compiled.simd import Width
from stages.compiled.workspace import Workspace
from stages.data import PixelOrigin
from stages.matching.kernels.row_ranges import lanes_for
from stages.matching.kernels.selection import find_partners, find_winners, fit_row, select_reference
from stages.matching.kernels.speckles import drop_speckles, drop_speckles_reference
from stages.matching.kernels.texture import drop_unmatchable, drop_unmatchable_reference
from tests.conftest import slow
from tests.stages.matching.test_census import params_of


@njit
def select(total, beyond, guard, winner, votes, right, partners, first, params, layers, width):
    find_winners(total, beyond, guard, winner, votes, right, width)
    find_partners(winner, right, partners)
    fit_row(winner, votes, partners, first, params.disparities - 1, params, *layers)


@pytest.mark.parametrize("disparities", [64, 300, *slow(9, 90)])
@pytest.mark.parametrize("minimum", [0, -30, 25])
def test_a_row_is_selected_as_by_the_reference(disparities, minimum):
    rng = np.random.default_rng(disparities)
    lanes, columns = lanes_for(disparities), 150
    width = Width(lanes)
    total = rng.integers(5, 40, (columns, lanes)).astype(np.uint8)  # with many ties
    for x in range(columns):
        d = min(disparities - 1, max(0, 40 - minimum + 3 * (x // 20)))
        total[x, max(0, d - 1) : d + 2] = (4, 2, 3)[: len(total[x, max(0, d - 1) : d + 2])]
    guard = np.where(np.abs(np.arange(2 * lanes) - lanes) <= 1, 255, 0).astype(np.uint8)
    beyond = np.where(np.arange(lanes) < disparities, 0, 255).astype(np.uint8)
    params = params_of(disparities, minimum)._replace(uniqueness=1, lr_tolerance=1)
    expected = select_reference(total[:, :disparities], np.full(columns, minimum), minimum, disparities, params)
    index = np.uint8 if lanes <= 256 else np.uint16
    rows = np.empty(columns, np.int16), np.empty((4, columns), np.uint16), np.empty(columns + lanes, index)
    layers = tuple(np.empty(columns, kind) for kind in (np.float32, np.uint8, np.uint8))
    partners, first = np.empty(columns, np.int16), np.full(columns, minimum, np.int32)
    flat = np.append(total.ravel(), np.zeros(64, np.uint8))
    select(flat, beyond, guard, *rows, partners, first, params, layers, width)
    np.testing.assert_equal(layers, tuple(expected))
    if disparities >= 64 and minimum == 0:
        assert np.isfinite(layers[0]).sum() > 40


@given(st.integers(1, 30), st.integers(1, 30), st.integers(0, 12), st.integers(0, 2**32 - 1))
def test_speckles_are_the_small_components_of_a_graph(height, columns, largest, seed):
    rng = np.random.default_rng(seed)
    disparity = rng.integers(0, 4, (height, columns)).astype(np.float32)
    disparity[rng.random(disparity.shape) < 0.2] = np.nan
    evidence = np.where(np.isfinite(disparity), 9, 0).astype(np.uint8)
    source = np.where(evidence > 0, PixelOrigin.MEASURED, PixelOrigin.LEFT_RIGHT).astype(np.uint8)
    wanted = disparity.copy(), evidence.copy(), source.copy()
    drop_speckles_reference(*wanted, largest)
    for threads in (1, 2):
        found = disparity.copy(), evidence.copy(), source.copy()

        drop_speckles(*found, largest, Workspace(), shared_by(threads))
        np.testing.assert_equal(found, wanted)


@given(st.integers(1, 12), st.integers(1, 30), st.booleans(), st.integers(0, 2**32 - 1))
def test_excluded_and_blank_pixels_are_dropped_as_by_the_reference(height, columns, excludes, seed):
    rng = np.random.default_rng(seed)
    shape = height, columns
    contrasts = rng.integers(0, 3, (2, *shape)).astype(np.uint8)
    excluded = rng.choice(np.array([0, 5, 6], np.uint8), shape if excludes else (0, 0))
    evidence = rng.integers(0, 3, shape).astype(np.uint8)
    pixels = np.where(evidence > 0, rng.uniform(-3, 9, shape), np.nan).astype(np.float32)
    source = np.where(evidence > 0, 1, 7).astype(np.uint8)
    wanted, found = ([layer.copy() for layer in (pixels, evidence, source)] for _ in range(2))
    drop_unmatchable_reference(*contrasts, excluded, *wanted)
    drop_unmatchable(*contrasts, excluded, *found)
    np.testing.assert_equal(found, wanted)
