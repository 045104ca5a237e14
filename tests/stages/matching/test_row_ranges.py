"""Ranges of bands of rows: they hold what the prior has; the search in them is, bit for bit, that of the reference."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.compiled.simd import Width
from stages.data import PixelOrigin
from stages.matching.kernels import row_ranges as module
from stages.matching.kernels.aggregation import aggregate_reference
from stages.matching.kernels.gradient import smoothed_costs_reference
from stages.matching.kernels.matching_inputs import matching_inputs
from stages.matching.kernels.prior_cost import prior_costs, prior_costs_reference
from stages.matching.kernels.row_ranges import Range, lanes_for, move_paths, row_ranges
from stages.matching.kernels.selection import costs_reference, select_reference
from stages.matching.kernels.semiglobal import match
from stages.matching.kernels.texture import contrast, drop_unmatchable_reference
from stages.matching.match import Match
from tests.stages.builders import disparity_of
from tests.stages.matching.pairs import SLOPE, TRUTH, same
from tests.stages.matching.test_census import params_of
from tests.stages.matching.test_sgm_local import views


@given(
    st.integers(1, 70), st.integers(1, 40), st.integers(1, 80), st.integers(-40, 40), st.integers(1, 400),
    st.integers(0, 2**32 - 1),
)  # fmt: skip
def test_every_row_is_in_one_band_whose_range_holds_its_prior(rows, columns, band, minimum, disparities, seed):
    rng = np.random.default_rng(seed)
    middle = rng.uniform(minimum, minimum + disparities, (rows, 1))
    prior = (middle + rng.uniform(-20, 20, (rows, columns))).astype(np.float32)
    prior[rng.random(prior.shape) < 0.3] = np.nan
    prior[: rng.integers(0, rows + 1) // 2] = np.nan  # sky
    found = row_ranges(prior, band, minimum, disparities)
    assert [row for each in found for row in range(each.top, each.end)] == list(range(rows))
    for each in found:
        assert each.end - each.top <= band
        first, last = minimum + each.first, minimum + each.first + each.width.lanes - 1
        if each.width.lanes == lanes_for(disparities):
            assert each.first == 0
            continue
        assert each.first >= 0
        assert each.first + each.width.lanes <= disparities
        assert each.width.lanes in module.NARROW_LANES
        inside = prior[each.top : each.end]
        known = np.clip(inside[np.isfinite(inside)], minimum, minimum + disparities - 1)
        if known.size >= module.MIN_KNOWN_SHARE * inside.size:
            assert first <= max(known.min() - module.RANGE_MARGIN + 1, minimum)
            assert last >= min(known.max() + module.RANGE_MARGIN - 1, minimum + disparities - 1)


def test_specks_do_not_widen_a_range():
    prior = np.full((64, 1000), 40, np.float32)
    prior[3, :30], prior[5, :30] = 150, 2  # 60 of 64000 pixels
    prior[7, :3] = 1e30, -1e30, np.inf
    (band,) = row_ranges(prior, 64, 0, 192)
    assert (band.first, band.width.lanes) == (40 - 31, 64)


def test_a_band_that_is_mostly_unknown_also_has_the_range_of_the_bands_around_it():
    prior = np.full((256, 100), np.nan, np.float32)
    prior[100:128, :80], prior[128:192], prior[192:] = 10, 20, 100
    assert [(each.first, each.width.lanes) for each in row_ranges(prior, 64, 0, 192)] == [
        (0, 64),  # sky: two bands below it have enough known pixels, and far ground only
        (0, 64),  # the horizon
        (0, 64),
        (69, 64),
    ]
    prior[128:] = np.nan
    assert [(each.first, each.width.lanes) for each in row_ranges(prior, 64, 0, 192)] == 4 * [(0, 192)]


@given(st.sampled_from([16, 64, 96, 128]), st.sampled_from([16, 64, 96, 128]), st.integers(-200, 200))
def test_moved_paths_keep_what_both_ranges_have(lanes, other_lanes, later):
    paths = np.random.default_rng(0).integers(0, 255, (5, lanes)).astype(np.uint8)
    moved = np.zeros(5 * other_lanes, np.uint8)
    move_paths(paths.reshape(-1), lanes, later, moved, other_lanes)
    wide = np.pad(paths, ((0, 0), (400, 400)), constant_values=255)
    np.testing.assert_array_equal(moved.reshape(5, -1), wide[:, 400 + later : 400 + later + other_lanes])


@settings(max_examples=10, deadline=None)
@given(
    st.booleans(), st.sampled_from([0, -9, -60, 7]), st.sampled_from([65, 96, 100, 130, 192]),
    st.integers(0, 2**32 - 1),
)  # fmt: skip
def test_disparities_are_those_of_a_search_without_the_rest_of_the_range(diagonals, minimum, disparities, seed):
    rng = np.random.default_rng(seed)
    height, columns, whole = 9, 40, lanes_for(disparities)
    truth = rng.integers(2, 30) + np.where(np.arange(height) < 4, 0, 12)[:, np.newaxis] + np.zeros(columns)
    left, right = views(height, columns, truth)
    prior = (truth + rng.normal(0, 2, truth.shape)).astype(np.float32)
    cuts = [0, *sorted(rng.choice(range(1, height), 3, replace=False).tolist()), height]
    ranges = []
    for top, end in itertools.pairwise(cuts):
        lanes = int(rng.choice([n for n in (*module.NARROW_LANES, whole) if n < disparities or n == whole]))
        first = 0 if lanes == whole else int(rng.integers(0, disparities - lanes + 1))
        ranges.append(Range(top, end, first, Width(lanes)))
    table = np.round(12 + 90 / (1 + np.arange(256) / 10)).astype(np.uint8)
    params = params_of(disparities, minimum)._replace(
        diagonals=diagonals, p2_table=table, uniqueness=1, confidence_of=np.linspace(0, 1, 256).astype(np.float32)
    )
    first = np.concatenate([np.full((each.end - each.top, 1), minimum + each.first) for each in ranges])
    guide = prior_costs(prior, first, whole, 0.5, 4.0)

    inputs = matching_inputs(left, right, params, Width(whole))
    planes = matching_inputs(right, right, params, Width(whole)).left[:, :, :columns]
    costs = smoothed_costs_reference(inputs.left[:, :, :columns], planes, whole, minimum, params.unseen_cost)
    costs = np.minimum(costs + prior_costs_reference(prior, minimum, whole, 0.5, 4.0).astype(int), 255)
    searched = np.zeros(costs.shape, bool)
    for each in ranges:
        searched[each.top : each.end, :, each.first : each.first + each.width.lanes] = True
    down, up = (aggregate_reference(inputs.steps, params, costs, searched, sign, beside=False) for sign in (1, -1))
    pixels, evidence, source = (np.empty(truth.shape, kind) for kind in (np.float32, np.uint8, np.uint8))
    kept = np.empty((2, *truth.shape), np.uint8)
    for each in ranges:
        n, least = min(each.width.lanes, disparities), minimum + each.first
        total = np.minimum(down + up, 255)[:, :, each.first : each.first + n]
        for y in range(each.top, each.end):
            row = select_reference(total[y], np.full(columns, least), least, n, params)
            pixels[y], evidence[y], source[y] = row
            kept[:, y] = costs_reference(total[y])
    contrasts = (contrast(image, 0, len(image)) for image in (left, right))
    drop_unmatchable_reference(*contrasts, np.empty((0, 0), np.uint8), pixels, evidence, source)
    for threads, memory in ((1, 1 << 30), (2, 1 << 30), (1, 1), (2, 1)):
        found = match(left, right, params, guide, ranges, None, threads, memory)
        np.testing.assert_array_equal(found.pixels, pixels)
        np.testing.assert_array_equal(found.source, source)
        np.testing.assert_array_equal(found.confidence, params.confidence_of[evidence])
        np.testing.assert_array_equal(found.costs, kept)


@pytest.mark.parametrize("paths", [4, 8])
def test_bands_find_what_the_whole_range_finds(paths):
    whole, prior = Match(disparities=192, paths=paths), disparity_of(TRUTH, PixelOrigin.FILLED)
    bands = replace(whole, band_height=16)
    one, other = whole(SLOPE, prior), bands(SLOPE, prior)
    visible = np.arange(320) >= TRUTH + 2
    either = np.isfinite(one.pixels) | np.isfinite(other.pixels)
    assert (np.abs(one.pixels - other.pixels) < 0.3)[visible & either].mean() > 0.98
    for threads, memory in ((2, 400), (1, 1), (2, 1)):
        assert same(replace(bands, threads=threads, max_memory=memory)(SLOPE, prior), other)


def test_a_match_that_the_prior_has_outside_its_bands_range_is_unknown():
    moved = TRUTH.copy()
    moved[40, 100:115] = 150  # 15 of 64 rows of 320 pixels: a speck
    found = Match(disparities=192, band_height=64)(SLOPE, disparity_of(moved))
    assert np.isnan(found.pixels[40, 100:115]).all()
    assert np.isfinite(found.pixels[41, 100:115]).all()
