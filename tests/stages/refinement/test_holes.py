"""Holes: filled from the background and from similar colours, never across an edge, and open without evidence."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages.refinement.kernels.holes import KEPT, MISMATCH, OCCLUSION, OPEN, fill_holes, fill_holes_reference
from stages.refinement.kernels.valid_extent import extent

FAR, NEAR = 5.0, 25.0
DARK, BRIGHT = 60, 190


def random_disparity(height, width, seed):
    rng = np.random.default_rng(seed)
    disparity = rng.uniform(0, 12, (height, width)).astype(np.float32)
    disparity[rng.random((height, width)) < rng.uniform(0.3, 0.97)] = np.nan
    shape = (height, width, 3) if seed % 2 else (height, width)
    return disparity, rng.integers(0, rng.choice([2, 40, 100, 256]), shape).astype(np.uint8)


def filled(disparity, image, reach=64, margin=100):
    return fill_holes(disparity, image, extent(disparity), reach, margin)


@given(st.integers(1, 24), st.integers(1, 40), st.sampled_from([0.0, 4.0, 64.0]), st.sampled_from([0.0, 3.0, 16.0]),
       st.integers(0, 2**31), st.sampled_from([1, 2]))  # fmt: skip
def test_the_fill_equals_its_reference_bit_by_bit(height, width, reach, margin, seed, threads):
    disparity, image = random_disparity(height, width, seed)
    within = extent(disparity)
    ours, kinds = fill_holes(disparity, image, within, reach, margin, threads)
    expected, expected_kinds = fill_holes_reference(disparity, image, within, reach, margin)
    assert ours.tobytes() == expected.tobytes()
    assert np.array_equal(kinds, expected_kinds)


@pytest.fixture
def box():
    """A bright box before a dark ground, in disparity and image: columns 40 to 79, rows 20 to 59 of 80x120."""
    disparity, image = np.full((80, 120), FAR, np.float32), np.full((80, 120), DARK, np.uint8)
    disparity[20:60, 40:80], image[20:60, 40:80] = NEAR, BRIGHT
    return disparity, image


def test_occluded_holes_take_the_background(box):
    disparity, image = box
    hidden = np.s_[20:60, 20:40]  # as wide as the step, on the side that the right camera does not see
    disparity[hidden] = np.nan
    result, kinds = filled(disparity, image)
    assert (result[hidden] == FAR).all()
    assert (kinds[20:60, 22:40] == OCCLUSION).all()  # of the last two nothing is sure
    kinds[hidden] = KEPT
    assert (kinds == KEPT).all()


@pytest.mark.parametrize("bright", [BRIGHT, DARK + 45])  # behind an edge, or only less like
def test_a_mismatch_is_filled_up_to_the_image_edge(box, bright):
    disparity, image = box
    image[image == BRIGHT] = bright
    truth = disparity.copy()
    hole = np.s_[30:50, 70:90]  # across the box's right edge
    disparity[hole] = np.nan
    result, kinds = filled(disparity, image)
    # the image is averaged over 3 px: next to the edge it leans to neither side
    sure = np.delete(np.arange(70, 90), [9, 10])
    assert np.array_equal(result[30:50, sure], truth[30:50, sure])
    assert (kinds[30:50, sure] == MISMATCH).all()


def test_a_gap_between_two_near_objects_takes_the_ground():
    disparity, image = np.full((60, 80), NEAR, np.float32), np.full((60, 80), BRIGHT, np.uint8)
    gap = np.s_[:, 30:50]
    disparity[gap], image[gap] = FAR, DARK
    disparity[20:40, 28:52] = np.nan
    result, _ = filled(disparity, image)
    assert (result[20:40, 31:49] == FAR).all()


@pytest.mark.parametrize("flip", [1, -1])
def test_ground_at_the_border_does_not_take_an_objects_disparity(flip):
    disparity, image = np.full((40, 60), NEAR, np.float32), np.full((40, 60), BRIGHT, np.uint8)
    disparity[:, 45:], image[:, 45:] = np.nan, DARK
    result, kinds = filled(disparity[:, ::flip].copy(), image[:, ::flip].copy())
    assert np.isnan(result[:, ::flip][:, 46:]).all()
    assert (kinds[:, ::flip][:, 46:] == OPEN).all()
    # of the object's own colour it may be the object's
    same, _ = filled(disparity[:, ::flip].copy(), np.full_like(image, BRIGHT))
    assert (same[:, ::flip][:, 46:] == NEAR).all()


def test_a_hole_in_one_surface_is_interpolated():
    disparity = np.full((1, 100), np.nan, np.float32)
    disparity[0, :30], disparity[0, 39:] = 10, 11
    result, kinds = filled(disparity, np.full((1, 100), 90, np.uint8))
    assert np.allclose(result[0, 29:40], np.linspace(10, 11, 11), atol=1e-5)
    assert (kinds[0, 30:39] == MISMATCH).all()


def test_only_occluded_holes_are_filled_from_beyond_max_distance():
    disparity, image = np.full((1, 200), np.nan, np.float32), np.full((1, 200), DARK, np.uint8)
    disparity[0, :50], disparity[0, 150:] = FAR, FAR
    result, _ = filled(disparity, image, reach=20)
    assert np.array_equal(np.flatnonzero(np.isnan(result)), np.arange(70, 130))
    disparity[0, 150:], image[0, 150:] = FAR + 60, BRIGHT  # which hides 60 px of what is at FAR, to its left
    result, kinds = filled(disparity, image, reach=20)
    assert (result[0, 92:149] == FAR).all()
    assert (kinds[0, 92:149] == OCCLUSION).all()
    assert np.array_equal(np.flatnonzero(np.isnan(result)), np.arange(70, 92))


@pytest.fixture
def bay():
    """Ground known below row 12 in columns 10 to 39, and all along row 0, of 30x50: no sky but in columns 45 up."""
    disparity = np.full((30, 50), np.nan, np.float32)
    disparity[12:, 10:40], disparity[0, :45] = FAR, FAR
    return disparity


def test_nothing_is_filled_beyond_the_margin(bay):
    result, _ = filled(bay, np.full((30, 50), 90, np.uint8), margin=4)
    known = np.zeros((30, 50), bool)
    known[12:, 6:44] = known[0, :45] = True
    assert np.array_equal(np.isfinite(result), known)


def test_nothing_is_filled_above_the_margin_of_a_column(bay):
    bay[0, 1:45] = np.nan
    bay[1:12, 0] = bay[1:12, 49] = FAR
    result, _ = filled(bay, np.full((30, 50), 90, np.uint8), margin=4)
    assert np.array_equal(np.isfinite(result[:, 20]), np.arange(30) >= 8)
