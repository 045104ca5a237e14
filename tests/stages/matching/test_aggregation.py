"""Aggregation: both sweeps give, bit for bit, the sums of the plain reference; priors are costs like any other."""

import numpy as np
import pytest
from numba import njit

from stages.compiled.simd import Width
from stages.matching.kernels.aggregation import aggregate_reference, aggregate_row, brightness_steps
from stages.matching.kernels.matching_inputs import NO_PRIOR, MatchingInputs
from stages.matching.kernels.prior_cost import prior_costs, prior_costs_reference
from tests.conftest import slow
from tests.stages.matching.pairs import textured
from tests.stages.matching.test_census import params_of


@njit
def sweep(costs, inputs, params, paths, step, sums, total, final, width):
    height, size = costs.shape
    for i in range(height):
        y = i if step > 0 else height - 1 - i
        aggregate_row(inputs, params, costs[y], paths, y, step, sums, y * size, total[y], final, width)


@pytest.mark.parametrize("lanes", [96, *slow(16, 192)])
@pytest.mark.parametrize("paths", [4, 8])
@pytest.mark.parametrize(("height", "columns"), [(9, 23), (30, 5)])
@pytest.mark.parametrize("pull", [None, (0.5, 4.0), (16.0, 64.0)])  # weight and reach: the last costs more than 255
def test_sums_are_those_of_the_reference(lanes, paths, height, columns, pull):
    rng = np.random.default_rng(lanes + paths)
    image = textured(height, columns).astype(np.uint8)
    table = np.round(12 + 90 / (1 + np.arange(256) / 10)).astype(np.uint8)
    costs = rng.integers(0, 60, (height, columns, lanes)).astype(np.uint8)
    prior, expected = NO_PRIOR, costs
    if pull:
        near = rng.uniform(0, lanes, image.shape).astype(np.float32)
        near[rng.random(image.shape) < 0.3] = np.nan
        prior = prior_costs(near, 0, lanes, *pull)
        expected = np.minimum(costs.astype(int) + prior_costs_reference(near, 0, lanes, *pull), 255).astype(np.uint8)
    planes = np.zeros((height, 3, columns), np.uint8)
    inputs = MatchingInputs(planes, planes, brightness_steps(image), np.zeros(1, np.uint8), 0, columns, *prior)
    params = params_of(lanes, 0)._replace(p1=9, diagonals=paths == 8, p2_table=table)
    everything = np.ones(costs.shape, bool)
    down, up = (aggregate_reference(inputs.steps, params, expected, everything, sign) for sign in (1, -1))
    size, width = columns * lanes, Width(lanes)
    flat = costs.reshape(height, size)
    sums, total = np.full(height * size, 3, np.uint8), np.zeros((height, size), np.uint8)
    sweep(flat, inputs, params, np.zeros(3 * size, np.uint8), 1, sums, total, False, width)
    assert np.array_equal(sums.reshape(costs.shape), down)
    sweep(flat, inputs, params, np.zeros(3 * size, np.uint8), -1, sums, total, True, width)
    assert np.array_equal(total.reshape(costs.shape), np.minimum(down + up, 255))


def test_brightness_steps_are_differences_to_the_neighbours():
    image = textured(7, 70).astype(np.uint8)
    steps, levels = brightness_steps(image), image.astype(int)
    assert np.array_equal(steps[0, :7, 2:71], np.abs(levels[:, 1:] - levels[:, :-1]))
    assert np.array_equal(steps[1, 1:7, 2:71], np.abs(levels[1:, 1:] - levels[:-1, :-1]))
    assert np.array_equal(steps[2, 1:7, 1:71], np.abs(levels[1:] - levels[:-1]))
    assert np.array_equal(steps[3, 1:7, 1:70], np.abs(levels[1:, :-1] - levels[:-1, 1:]))
