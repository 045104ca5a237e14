"""Aggregation: both sweeps give, bit for bit, the sums of the plain reference; priors are costs like any other."""

import numpy as np
import pytest
from numba import njit

from stages.kernels.aggregation import aggregate_reference, aggregate_row, brightness_steps
from stages.kernels.prior import add_prior, prior_costs
from stages.kernels.semiglobal import NO_PRIOR, Pair
from stages.kernels.vectors import Width
from tests.stages.test_census import rule_of
from tests.stages.test_match_opencv import textured


@njit
def sweep(costs, pair, rule, paths, step, sums, total, final, width):
    height, size = costs.shape
    for i in range(height):
        y = i if step > 0 else height - 1 - i
        aggregate_row(pair, rule, costs[y], False, paths, y, step, sums, y * size, total[y], final, width)


@njit
def pulled(costs, begin, table, width):
    add_prior(costs, begin, table, width)


@pytest.mark.parametrize("lanes", [16, 96, 192])
@pytest.mark.parametrize("paths", [4, 8])
@pytest.mark.parametrize(("height", "columns"), [(9, 23), (30, 5)])
def test_sums_are_those_of_the_reference(lanes, paths, height, columns):
    rng = np.random.default_rng(lanes + paths)
    image = textured(height, columns).astype(np.uint8)
    table = np.round(12 + 90 / (1 + np.arange(256) / 10)).astype(np.uint8)
    costs = rng.integers(0, 60, (height, columns, lanes)).astype(np.uint8)
    down, up = aggregate_reference(costs, image, table, 9, paths)
    planes = np.zeros((height, 3, columns), np.uint8)
    pair = Pair(planes, planes, brightness_steps(image), np.zeros(1, np.uint8), 0, columns, *NO_PRIOR)
    rule = rule_of(True, lanes, 0)._replace(diagonals=paths == 8, table=table)
    size, width = columns * lanes, Width(lanes)
    flat = costs.reshape(height, size)
    sums, total = np.full(height * size, 3, np.uint8), np.zeros((height, size), np.uint8)
    sweep(flat, pair, rule, np.zeros(3 * size, np.uint8), 1, sums, total, False, width)
    assert np.array_equal(sums.reshape(costs.shape), down)
    sweep(flat, pair, rule, np.zeros(3 * size, np.uint8), -1, sums, total, True, width)
    assert np.array_equal(total.reshape(costs.shape), np.minimum(down.astype(int) + up, 255))


def test_brightness_steps_are_differences_to_the_neighbours():
    image = textured(7, 70).astype(np.uint8)
    steps, levels = brightness_steps(image), image.astype(int)
    assert np.array_equal(steps[0, :7, 2:71], np.abs(levels[:, 1:] - levels[:, :-1]))
    assert np.array_equal(steps[1, 1:7, 2:71], np.abs(levels[1:, 1:] - levels[:-1, :-1]))
    assert np.array_equal(steps[2, 1:7, 1:71], np.abs(levels[1:] - levels[:-1]))
    assert np.array_equal(steps[3, 1:7, 1:70], np.abs(levels[1:, :-1] - levels[:-1, 1:]))


@pytest.mark.parametrize("minimum", [0, 7, -12])
def test_a_prior_costs_its_weight_for_each_pixel_of_distance_up_to_its_reach(minimum):
    prior = np.array([[np.nan, 10.0, 10.25, 9.6, -300.0, 5000.0, minimum, minimum + 31]], np.float32)
    begin, table = prior_costs(prior, minimum, 32, 2.0, 5.0)
    costs = np.full(8 * 32, 30, np.uint8)
    pulled(costs, begin[0], table, Width(32))
    quarters = np.round(prior[0] * 4) / 4
    distance = np.abs(np.arange(32) + minimum - quarters[:, np.newaxis])
    expected = 30 + np.round(2.0 * np.minimum(np.nan_to_num(distance), 5.0))
    assert np.array_equal(costs.reshape(8, 32), expected)
