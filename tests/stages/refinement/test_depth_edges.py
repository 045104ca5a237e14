"""Depth edges: the choice of a surface equals the plain reference and moves an edge to where the images have it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages.refinement.kernels.depth_edges import sharpen_edges, sharpen_edges_reference

RADIUS = 3


def sharpened(disparity, left, right=None):
    return sharpen_edges(disparity, np.zeros(disparity.shape, bool), left, left if right is None else right, RADIUS)


@given(st.integers(1, 14), st.integers(1, 14), st.integers(1, 5), st.integers(0, 2**31), st.sampled_from([(), (3,)]))
def test_the_choice_equals_its_reference(height, width, radius, seed, channels):
    random = np.random.default_rng(seed)
    disparity = np.float32(random.choice([-900.0, 3.0, 5.0], (height, width)) + random.normal(0, 0.2, (height, width)))
    disparity[random.random(disparity.shape) < 0.2] = np.nan
    left, right = random.integers(0, 60, (2, height, width, *channels), np.uint8)
    everything = disparity, random.random(disparity.shape) < 0.3, left, right, radius
    sharp = sharpen_edges(*everything)
    np.testing.assert_array_equal(sharp, sharpen_edges_reference(*everything))
    np.testing.assert_array_equal(sharp, sharpen_edges(*everything, threads=2))


@pytest.mark.parametrize("shades", [((80, 80, 80), (140, 140, 140)), ((120, 90, 100), (90, 106, 98))])
def test_a_misplaced_depth_edge_moves_onto_the_image_edge(shades):
    """Also onto one that only colours show, and by two pixels."""
    image = np.full((40, 60, 3), shades[0], np.uint8)
    image[:, 30:] = shades[1]
    truth = np.full((40, 60), 10, np.float32)
    truth[:, 30:] = 30
    off, farther = truth.copy(), truth.copy()
    off[:20, 29], off[20:, 30], off[::7, 30], farther[:, 28:30] = 30, 10, 10, 30
    assert np.array_equal(sharpened(off, image), truth)
    assert np.array_equal(sharpened(farther, image), truth)


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (0.85, 12.0)])
def test_texture_moves_an_edge_where_brightness_shows_none(gain, offset):
    """Both surfaces have the same brightness and texture; only the second image contains the edge."""
    random = np.random.default_rng(3)
    right = random.normal(120, 25, (60, 90))
    truth = np.full(right.shape, 4, np.float32)
    truth[10:40, 40:70] = 9
    columns = np.arange(90) - truth.astype(int)
    left = np.take_along_axis(right, columns.clip(0), axis=1)
    images = (image.clip(0, 255).astype(np.uint8) for image in (left, gain * right + offset))
    wide = truth.copy()
    wide[10:40, 70] = 9  # one column too wide on its right, which both cameras see
    moved = sharpened(wide, *images)
    assert np.count_nonzero(moved[10:40, 70] != 4) <= 2
    assert np.count_nonzero(moved != truth) <= 0.2 * np.count_nonzero(wide != truth) + 8


def test_ground_without_a_jump_and_unknown_pixels_stay():
    ground = np.repeat(5 + np.arange(30, dtype=np.float32)[:, None], 40, axis=1)
    ground[3:6, 7:9] = np.nan
    image = np.random.default_rng(0).integers(0, 256, (30, 40), np.uint8)
    assert np.array_equal(sharpened(ground, image), ground, equal_nan=True)
    ground[:, 20:] += 9
    sharp = sharpened(ground, image)
    assert np.array_equal(np.isnan(sharp), np.isnan(ground))
    assert np.array_equal(sharp[:, :18], ground[:, :18], equal_nan=True)


def test_guesses_do_not_move_matches_but_follow_them():
    disparity, image = np.full((20, 20), 10, np.float32), np.full((20, 20), 90, np.uint8)
    disparity[9:11, 9:11] = 30
    guessed = disparity == 10
    assert np.array_equal(sharpen_edges(disparity, guessed, image, image, RADIUS), disparity)
    assert (sharpen_edges(disparity, ~guessed, image, image, RADIUS) == 10).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1)])
def test_images_of_a_row_or_a_column_work(shape):
    disparity = np.arange(np.prod(shape), dtype=np.float32).reshape(shape) * 4
    image = np.zeros(shape, np.uint8)
    everything = disparity, np.zeros(shape, bool), image, image, RADIUS
    assert np.array_equal(sharpen_edges(*everything), sharpen_edges_reference(*everything))
