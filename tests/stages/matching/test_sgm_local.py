"""The search around a prior: bit for bit its reference, whatever the windows; and the windows hold the prior."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages.compiled.parallel import shared_by
from stages.compiled.simd import Width
from stages.compiled.workspace import Workspace
from stages.matching.kernels.matching_inputs import matching_inputs
from stages.matching.kernels.prior_cost import prior_costs
from stages.matching.kernels.sgm_local import WINDOW_EDGE, SearchWindows, match_windows, windows_around
from stages.matching.kernels.sgm_local import match_windows_reference as plain_match
from tests.stages.matching.pairs import textured
from tests.stages.matching.test_census import params_of


def views(height, columns, disparity):
    """The images, (H, W) uint8, of a surface of these disparities, (H, W) or a number of px."""
    right = textured(height, columns, 3)
    x = np.arange(columns) - np.broadcast_to(disparity, (height, columns))
    left = np.stack([np.interp(line, np.arange(columns), row) for line, row in zip(x, right, strict=True)])
    return left.astype(np.uint8), right.astype(np.uint8)


def searched(images, params, found, guide, threads):
    left, right = images
    shapes = (np.float32, left.shape), (np.uint8, left.shape), (np.uint8, left.shape), (np.uint8, (2, *left.shape))
    layers = tuple(np.empty(shape, kind) for kind, shape in shapes)
    run_both = shared_by(threads)
    inputs = matching_inputs(left, right, params._replace(min_disparity=0), found.width, guide, run_both)
    match_windows(inputs, params, found, layers, Workspace(), run_both)
    return inputs, layers


@pytest.mark.parametrize("diagonals", [True, False])
@pytest.mark.parametrize("lanes", [16, 32, 48])
def test_disparities_evidence_and_costs_are_those_of_the_reference(diagonals, lanes):
    rng = np.random.default_rng(lanes)
    height, columns = 11, 60
    disparity = np.where(np.arange(columns) < 30, 9.0, 21.0)  # a step, wider than the narrowest windows
    images = views(height, columns, disparity)
    prior = np.broadcast_to(disparity, (height, columns)) + rng.normal(0, 2, (height, columns)).astype(np.float32)
    prior[rng.random(prior.shape) < 0.1] += 40  # windows that share nothing with their neighbours'
    begin = np.rint(prior - lanes / 2).astype(np.int32)
    first = np.minimum(np.maximum(begin, np.arange(columns) - columns + 1), np.arange(columns)).astype(np.int32)
    found = SearchWindows(first, Width(lanes))
    slope = rng.integers(-1, 2, prior.shape, np.int8)
    guide = *prior_costs((prior - first).astype(np.float32), 0, lanes, 0.5, 4.0), slope
    table = np.round(12 + 90 / (1 + np.arange(256) / 10)).astype(np.uint8)
    params = params_of(64, 0)._replace(diagonals=diagonals, p2_table=table, uniqueness=1)
    inputs, layers = searched(images, params, found, guide, 1)
    assert np.isfinite(layers[0]).mean() > 0.2
    np.testing.assert_equal(layers, tuple(plain_match(inputs, params, found)))
    np.testing.assert_equal(layers, searched(images, params, found, guide, 2)[1])


@given(st.integers(1, 9), st.integers(1, 300), st.integers(1, 20), st.integers(-40, 40), st.integers(0, 2**32 - 1))
def test_a_window_reaches_as_far_as_asked_to_either_side_of_the_prior(height, columns, reach, least, seed):
    rng = np.random.default_rng(seed)
    prior = rng.uniform(-60, 320, (height, columns)).astype(np.float32)
    prior[rng.random(prior.shape) < 0.2] = np.nan
    prior[rng.random(prior.shape) < 0.05] = 1e30
    first, width = windows_around(prior, reach, least)
    x = np.arange(columns)
    assert (first <= x).all()  # it begins in the image
    assert (first >= x - columns + 1).all()
    assert (first >= np.minimum(least, x)).all()
    assert (first == x)[prior > 1e6].all()
    free = np.isfinite(prior) & (first < x) & (first > np.maximum(least, x - columns + 1))
    assert (first + WINDOW_EDGE <= prior - reach)[free].all()
    assert (prior + reach <= first + width.lanes - 1 - WINDOW_EDGE)[free].all()


def test_an_image_of_one_row_and_one_without_any_prior_are_searched():
    images = views(1, 40, 8.0)
    params = params_of(64, 0)
    for value in (8, np.nan):
        prior = np.full((1, 40), value, np.float32)
        found = windows_around(prior, 4, 0)
        guide = prior_costs(np.subtract(prior, found.first, dtype=np.float32), 0, 16, 0.5, 4.0)
        inputs, layers = searched(images, params, found, guide, 2)
        np.testing.assert_equal(layers, tuple(plain_match(inputs, params, found)))
