"""Matching costs: the compiled planes and costs are, bit for bit, those of the plain references."""

import numpy as np
import pytest
from numba import njit

from stages.compiled.simd import Width, lanes_in, store
from stages.matching.kernels.census import census, census_costs, census_costs_reference, census_reference
from stages.matching.kernels.gradient import gradients, gradients_reference, smoothed_costs, smoothed_costs_reference
from stages.matching.kernels.matching_inputs import matching_inputs
from stages.matching.kernels.row_ranges import lanes_for
from stages.matching.kernels.sgm_params import SgmParams
from tests.conftest import slow
from tests.stages.matching.pairs import textured


@njit
def rows_of_census(inputs, unseen_cost, costs, width):
    n = lanes_in(width)
    columns = costs.shape[1] // n
    for y in range(costs.shape[0]):
        for x in range(columns):
            made = census_costs(inputs.left[y], inputs.right[y], inputs, unseen_cost, x, columns - 1 - x, width)
            store(costs[y], x * n, made)


@njit
def rows_smoothed(inputs, unseen_cost, costs, sums, step, width):
    height = costs.shape[0]
    first = 0 if step > 0 else height - 1
    for ahead in (first - step, first):
        smoothed_costs(inputs, unseen_cost, 0, ahead, sums, costs[first], width)
    for i in range(height):
        smoothed_costs(inputs, unseen_cost, 0, first + (i + 1) * step, sums, costs[first + i * step], width)


def params_of(gradient, disparities, minimum):
    nothing = np.zeros(256, np.uint8)
    return SgmParams(
        gradient, True, 9, nothing, 11, disparities, minimum, 0, 1, 1.0, 0, nothing.astype(np.float32), True
    )


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
    width, bits = Width(lanes), [census_reference(image) for image in images]
    planes = [np.concatenate([b, gradients_reference(i)], axis=1) for b, i in zip(bits, images, strict=True)]
    costs = np.empty((21, 77 * lanes), np.uint8)
    for gradient in (False, True):
        params = params_of(gradient, disparities, minimum)
        inputs = matching_inputs(left, right, params, width)
        if gradient:
            expected = smoothed_costs_reference(*planes, lanes, minimum, params.unseen_cost)
            for step in (1, -1):
                costs[:] = 7
                rows_smoothed(inputs, params.unseen_cost, costs, np.empty((2, 77 * lanes), np.uint8), step, width)
                assert np.array_equal(costs.reshape(expected.shape), expected)
        else:
            expected = census_costs_reference(*bits, lanes, minimum, params.unseen_cost)
            rows_of_census(inputs, params.unseen_cost, costs, width)
            assert np.array_equal(costs.reshape(expected.shape), expected)
