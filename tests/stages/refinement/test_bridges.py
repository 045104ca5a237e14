"""Bridges: flanks that both cameras see take a line; what is hidden, and what the images fit, keeps the background."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages.refinement.kernels.bridges import bridge_holes, bridge_holes_reference
from stages.refinement.kernels.holes import BRIDGE, KEPT, MISMATCH, OCCLUSION, fill_holes
from stages.refinement.kernels.valid_extent import extent

GROUND, TOP = 10.0, 22.0
HEIGHT, WIDTH, FIRST, END = 24, 160, 70, 100  # columns of the flank of a boulder


@given(st.integers(1, 12), st.integers(1, 60), st.integers(0, 2**31))
def test_bridges_equal_their_reference_bit_by_bit(height, width, seed):
    rng = np.random.default_rng(seed)
    disparity = np.repeat(rng.uniform(0, 30, (height, width // 6 + 1)), 6, axis=1)[:, :width].astype(np.float32)
    for y, x, length in zip(rng.integers(0, height, 9), rng.integers(0, width, 9), rng.integers(1, 20, 9), strict=True):
        disparity[y, x : x + length] = np.nan
    left, right = rng.integers(0, rng.choice([8, 60, 256]), (2, height, width)).astype(np.uint8)
    found = fill_holes(disparity, left, extent(disparity), 64, 8)
    filled, kinds = bridge_holes_reference(disparity, *found, left, right)
    ours, our_kinds = bridge_holes(disparity, *found, left, right)
    assert ours.tobytes() == filled.tobytes()
    assert np.array_equal(our_kinds, kinds)


def scene(flank):
    """Disparities of ground and boulder with a hole between, and images of a scene with disparities `flank` there."""
    disparity = np.full((HEIGHT, WIDTH), GROUND, np.float32)
    disparity[:, END:] = TOP
    true = disparity.copy()
    true[:, FIRST:END] = flank
    disparity[:, FIRST:END] = np.nan
    return disparity, *images(true)


def images(true):
    """The two images of a scene of random texture with these disparities."""
    right = np.random.default_rng(3).integers(60, 190, (HEIGHT, WIDTH)).astype(np.uint8)
    places = np.arange(WIDTH) - true
    left = np.stack([np.interp(place, np.arange(WIDTH), row) for place, row in zip(places, right, strict=True)])
    return left.astype(np.uint8), right


def bridged(disparity, left, right):
    """The result where the holes were filled with ground; the boulder hides as much of it as its step."""
    hole, hidden = np.isnan(disparity), np.arange(WIDTH) >= END - (TOP - GROUND)
    kinds = np.where(hole, np.where(hidden, np.uint8(OCCLUSION), np.uint8(MISMATCH)), np.uint8(KEPT))
    return bridge_holes(disparity, np.where(hole, np.float32(GROUND), disparity), kinds, left, right)


LINE = np.linspace(GROUND, TOP, END - FIRST + 2)[1:-1]


def test_a_flank_takes_the_line_between_its_ends():
    disparity, left, right = scene(LINE)
    filled, kinds = bridged(disparity, left, right)
    np.testing.assert_allclose(filled[:, FIRST:END], np.tile(LINE, (HEIGHT, 1)), atol=1e-5)
    assert (kinds[:, FIRST:END] == BRIDGE).all()
    assert (kinds[:, :FIRST] == KEPT).all()


@pytest.mark.parametrize(("length", "kind"), [(3, MISMATCH), (4, BRIDGE)])
def test_a_flank_of_four_pixels_is_the_narrowest_bridge(length, kind):
    disparity = np.full((HEIGHT, WIDTH), GROUND, np.float32)
    disparity[:, :FIRST], disparity[:, FIRST : FIRST + length] = TOP, np.nan
    hole = np.isnan(disparity)
    filled, kinds = np.where(hole, np.float32(GROUND), disparity), np.where(hole, np.uint8(MISMATCH), np.uint8(KEPT))
    true = filled.copy()
    true[:, FIRST : FIRST + length] = np.linspace(TOP, GROUND, length + 2)[1:-1]
    _, found = bridge_holes(disparity, filled, kinds, *images(true))
    assert np.mean(found[hole] == kind) > 0.9


@pytest.mark.parametrize("noise", [0, 2])
def test_ground_that_the_images_fit_stays_ground(noise):
    disparity, left, right = scene(GROUND)
    noisy = left.astype(int) + np.random.default_rng(0).integers(-noise, noise + 1, left.shape)
    filled, _ = bridged(disparity, np.clip(noisy, 0, 255).astype(np.uint8), right)
    assert (filled[:, FIRST:END] == GROUND).all()


def test_a_hole_as_wide_as_its_step_is_hidden():
    disparity, left, right = scene(LINE)
    disparity[:, FIRST : END - 12] = GROUND
    filled, kinds = bridged(disparity, left, right)
    assert (filled[:, FIRST:END] == GROUND).all()
    assert (kinds[:, END - 12 : END] == OCCLUSION).all()


def test_a_line_that_fits_the_images_no_better_is_no_bridge():
    disparity, left, right = scene(GROUND + 30)  # neither the ground's disparity nor the line's
    left[:, FIRST:END] = 255 - left[:, FIRST:END] // 8
    filled, _ = bridged(disparity, left, right)
    assert (filled[:, FIRST:END] == GROUND).all()
