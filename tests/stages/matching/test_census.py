"""Matching costs: the compiled planes and costs are, bit for bit, those of the plain references."""

import numpy as np
import pytest
from numba import njit

from stages.compiled.simd import Width
from stages.matching.kernels import gradient
from stages.matching.kernels.census import census, census_reference
from stages.matching.kernels.gradient import gradients, gradients_reference, smoothed_costs_reference, steep_slope
from stages.matching.kernels.matching_inputs import matching_inputs
from stages.matching.kernels.row_ranges import lanes_for
from stages.matching.kernels.sgm_params import SgmParams
from tests.conftest import slow
from tests.stages.matching.pairs import textured


@njit
def rows_smoothed(inputs, unseen_cost, costs, sums, step, width):
    height, spare = costs.shape[0], np.empty(costs.shape[1], np.uint8)
    first = 0 if step > 0 else height - 1
    for ahead in (first - step, first):
        gradient.smoothed_costs(inputs, unseen_cost, 0, ahead, sums, costs[first], width)
    for i in range(height):
        y = first + i * step
        slope = inputs.slope[y if inputs.slope.size > 0 else 0]
        gradient.set_aside(slope, step, sums[y + step & 1], spare, width)
        gradient.smoothed_costs(inputs, unseen_cost, 0, y + step, sums, costs[y], width)
        gradient.follow_slope(slope, step, spare, sums[y + step & 1], sums[y & 1], costs[y], width)


def params_of(disparities, minimum):
    nothing = np.zeros(256, np.uint8)
    return SgmParams(True, 9, nothing, 11, disparities, minimum, 0, 1, 0, nothing.astype(np.float32), True)


def planes_of(image):
    return np.concatenate([census_reference(image), gradients_reference(image)], axis=1)


@pytest.fixture(scope="module")
def images():
    return tuple(textured(21, 77, seed).astype(np.uint8) for seed in (1, 2))


@pytest.mark.parametrize("mirrored", [False, True])
def test_planes_are_those_of_the_references(images, mirrored):
    for image in images:
        planes = np.zeros((21, 5, 128), np.uint8)
        census(image, planes, mirrored)
        gradients(image, planes, mirrored)
        assert np.array_equal(planes[:, :3, :77], census_reference(image, mirrored))
        assert np.array_equal(planes[:, 3:, :77], gradients_reference(image, mirrored))


def test_a_mirrored_image_has_the_mirrored_planes(images):
    image = images[0]
    flipped = np.ascontiguousarray(image[:, ::-1])
    assert np.array_equal(census_reference(flipped, True)[:, :, ::-1], census_reference(image))
    assert np.array_equal(gradients_reference(flipped, True)[:, :, ::-1], gradients_reference(image))


def test_census_does_not_feel_exposure(images):
    brighter = (images[0] // 2 + 90).astype(np.uint8)
    assert np.array_equal(census_reference((images[0] // 2).astype(np.uint8)), census_reference(brighter))


@pytest.mark.parametrize(("disparities", "minimum"), [(40, 5), (20, -76), *slow((16, 0), (70, -30), (90, 60))])
def test_costs_are_those_of_the_references_at_every_pixel_and_disparity(images, disparities, minimum):
    left, right = images
    lanes = lanes_for(disparities)
    width, params = Width(lanes), params_of(disparities, minimum)
    inputs = matching_inputs(left, right, params, width)
    costs, sums = np.empty((21, 77 * lanes), np.uint8), np.empty((2, 77 * lanes), np.uint8)
    random = np.random.default_rng(3).integers(-1, 2, left.shape, np.int8)
    for slope in (None, np.pad(random, ((0, 0), (0, 3)))):
        expected = smoothed_costs_reference(*map(planes_of, images), lanes, minimum, params.unseen_cost, slope)
        sloping = inputs if slope is None else inputs._replace(slope=slope)
        for step in (1, -1):
            costs[:] = 7
            rows_smoothed(sloping, params.unseen_cost, costs, sums, step, width)
            assert np.array_equal(costs.reshape(expected.shape), expected)


@pytest.mark.parametrize(("rise", "expected"), [(1.1, 0), (1, 1), (0.5, 1), (0.4, 0), (0, 0), (-0.5, -1), (-1.1, 0)])
def test_a_prior_that_changes_by_half_a_pixel_to_one_a_row_is_steep(rise, expected):
    prior = np.repeat(60 + rise * np.arange(40, dtype=np.float32)[:, np.newaxis], 3, axis=1)
    prior[:, 1] = np.nan
    slope = steep_slope(prior)[:, :3]
    assert (slope[5:-5, [0, 2]] == expected).all()
    assert not slope[:, 1].any()
    assert not slope[:5].any()
    assert not slope[-5:].any()
    assert not steep_slope(prior[:10]).any()


@pytest.mark.parametrize("rise", [1, -1])
def test_costs_on_steep_ground_are_lower_where_the_mean_follows_it(rise):
    right = np.concatenate([textured(21, 60, 4), np.zeros((21, 4))], axis=1).astype(np.uint8)
    left = np.stack([np.roll(row, 20 + rise * (y - 10)) for y, row in enumerate(right)])
    planes = planes_of(left), planes_of(right)
    flat, along = (smoothed_costs_reference(*planes, 48, 0, 11, np.full(left.shape, slope)) for slope in (0, rise))
    y, x = np.mgrid[3:18, 36:60]
    assert along[y, x, 20 + rise * (y - 10)].mean() < flat[y, x, 20 + rise * (y - 10)].mean()
