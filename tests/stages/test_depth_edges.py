"""Depth edges: the weighted median is that of the plain reference, and puts an edge where the image has it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.kernels.depth_edges import sharpen_edges, sharpen_edges_reference


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 14), st.integers(1, 14), st.integers(1, 5), st.integers(0, 2**31))
def test_the_median_is_that_of_the_reference(height, width, radius, seed):
    random = np.random.default_rng(seed)
    disparity = np.float32(random.choice([-900.0, 3.0, 40.0], (height, width)) + random.normal(0, 0.2, (height, width)))
    disparity[random.random(disparity.shape) < 0.2] = np.nan
    image = random.integers(0, 60, (height, width), np.uint8)
    sharp = sharpen_edges(disparity, image, radius, 2.0, 10.0)
    np.testing.assert_array_equal(sharp, sharpen_edges_reference(disparity, image, radius, 2.0, 10.0))
    np.testing.assert_array_equal(sharp, sharpen_edges(disparity, image, radius, 2.0, 10.0, threads=2))


def test_an_edge_that_is_off_moves_to_that_of_the_image():
    image = np.full((40, 60), 80, np.uint8)
    image[:, 30:] = 140
    truth = np.where(image > 100, np.float32(30), np.float32(10))
    off = truth.copy()
    off[:20, 29], off[20:, 30], off[::7, 30] = 30, 10, 21
    assert np.array_equal(sharpen_edges(off, image, 3, 2.0, 10.0), truth)


def test_ground_without_a_jump_and_unknown_pixels_stay():
    ground = np.repeat(np.arange(5, 17, 0.4, np.float32)[:, None], 40, axis=1)
    ground[3:6, 7:9] = np.nan
    image = np.random.default_rng(0).integers(0, 256, (30, 40), np.uint8)
    assert np.array_equal(sharpen_edges(ground, image, 3, 2.0, 10.0), ground, equal_nan=True)
    ground[:, 20:] += 9
    sharp = sharpen_edges(ground, image, 3, 2.0, 10.0)
    assert np.array_equal(np.isnan(sharp), np.isnan(ground))
    assert np.array_equal(sharp[:, :18], ground[:, :18], equal_nan=True)


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1)])
def test_images_of_a_row_or_a_column_work(shape):
    disparity = np.arange(np.prod(shape), dtype=np.float32).reshape(shape) * 4
    image = np.zeros(shape, np.uint8)
    assert np.array_equal(
        sharpen_edges(disparity, image, 3, 2.0, 10.0), sharpen_edges_reference(disparity, image, 3, 2.0, 10.0)
    )
