"""Coarse to fine and from the other side: geometry is kept, and nothing is invented on the way."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages import Halve, LeftRightCheck, Match, PixelOrigin, StereoCamera, StereoFrame, SwapViews, Upsample
from stages.matching.kernels.lr_check import drop_inconsistent, drop_inconsistent_reference
from stages.matching.kernels.resample import doubled, doubled_reference, halved
from tests.stages.builders import disparity_of
from tests.stages.matching.pairs import frame_of


def slope_frame(height=97, width=131):
    """A textured ground whose disparity is 8 + 0.1 y, its camera with different principal points, and the truth."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:height, :width]
    waves = [(rng.uniform(0.2, 1.2), rng.uniform(0.2, 1.2), rng.uniform(0, 6)) for _ in range(12)]
    truth = 8 + 0.1 * y

    def texture(u):
        return sum(np.sin(a * u + b * y + c) for a, b, c in waves)

    left, right = (np.clip(128 + 18 * texture(u), 0, 255).astype(np.uint8) for u in (x, x + truth))
    camera = StereoCamera(200, 200, 60, 50, 0.2, width, height, 63)
    return StereoFrame(7, left, right, camera), truth.astype(np.float32)


def test_a_halved_frame_sees_the_same_depth():
    frame, truth = slope_frame()
    small = Halve()(frame)
    assert small.left.shape == (49, 66)
    camera = small.camera  # pixel 0 of the half lies between 0 and 1 of the whole
    assert (camera.fx, camera.cx, camera.cy, camera.cx_right) == (100, 29.75, 24.75, 31.25)
    disparity = Match(disparities=16, max_speckle_size=0)(small)
    depth = camera.fx * camera.baseline / (disparity.pixels + camera.cx_right - camera.cx)
    full = frame.camera
    expected = full.fx * full.baseline / (truth[:96:2, :130:2] + 0.05 + full.cx_right - full.cx)
    ratio = depth[:48, 16:65] / expected[:, 16:]
    assert np.isfinite(ratio).mean() > 0.8
    assert np.nanmedian(np.abs(ratio - 1)) < 0.02


def test_enlarging_doubles_disparities_between_pixels_of_one_surface_only():
    frame, truth = slope_frame()
    y = np.arange(49)[:, None] * np.ones(66)
    pixels = ((8 + 0.1 * (2 * y + 0.5)) / 2).astype(np.float32)
    pixels[:, 40:] += 20
    pixels[10:20, 10:20] = np.nan
    source = np.where(np.isnan(pixels), PixelOrigin.SPECKLE, PixelOrigin.PLANE)
    large = Upsample()(frame, disparity_of(pixels, source, stamp=7))
    assert large.pixels.shape == truth.shape
    known = np.isfinite(large.pixels)
    assert not known[20:40, 20:40].any()
    assert known.sum() == known.size - 400
    far, near = np.s_[2:95, :80], np.s_[2:95, 80:]
    assert np.nanmax(np.abs(large.pixels - truth)[far]) < 0.11
    assert np.nanmax(np.abs(large.pixels - truth - 40)[near]) < 0.11
    assert (large.source[known] == PixelOrigin.PLANE).all()
    assert (large.source[~known] == PixelOrigin.SPECKLE).all()


def test_swapping_twice_is_the_frame_itself_and_disparities_stay():
    frame, truth = slope_frame()
    swapped = SwapViews()(frame)
    again = SwapViews()(swapped)
    assert np.array_equal(again.left, frame.left)
    assert vars(again.camera) == vars(frame.camera)
    right = Match(disparities=32, max_speckle_size=0)(swapped).pixels[:, ::-1]  # of the right image's pixels
    assert np.nanmedian(np.abs(right - truth)[:, :100]) < 0.1
    camera = swapped.camera
    assert camera.cx_right - camera.cx == pytest.approx(frame.camera.cx_right - frame.camera.cx)


@given(st.integers(1, 9), st.integers(1, 30), st.sampled_from([0.5, 1.0, 3.0]), st.integers(0, 2**31))
def test_contradictions_equal_the_reference(height, width, tolerance, seed):
    rng = np.random.default_rng(seed)
    maps = rng.uniform(-3, 9, (2, height, width)).astype(np.float32)
    maps[rng.random(maps.shape) < 0.2] = np.nan
    sources, worth = rng.integers(0, 11, maps.shape, np.uint8), rng.random(maps.shape).astype(np.float32)
    found, backward = zip(maps, sources, worth, strict=True)
    for largest in (np.inf, 5.0):
        given = found, backward, tolerance, largest
        np.testing.assert_equal(drop_inconsistent(*given), drop_inconsistent_reference(*given))


def test_what_the_right_image_sees_otherwise_is_unknown():
    backward = np.full((2, 40), 5, np.float32)  # mirrored: left pixel x asks right pixel x - 5, at 39 - (x - 5)
    backward[:, 39 - (20 - 5)] = 9, np.nan
    given = disparity_of(np.full((2, 40), 5)), disparity_of(backward, PixelOrigin.MEASURED, 0.9)
    checked = LeftRightCheck()(*given)
    assert np.argwhere(np.isnan(checked.pixels)).tolist() == [[0, 20]]
    assert (checked.source[0, 20], checked.confidence[0, 20]) == (PixelOrigin.LEFT_RIGHT, 0)
    beyond = LeftRightCheck(disparities=4)(*given)
    assert np.isfinite(beyond.pixels).all()  # 5 px was not searched for from the right


def test_half_an_image_is_the_mean_of_four_and_repeats_an_odd_border():
    image = np.array([[0, 8, 100], [4, 16, 110], [20, 40, 7]], np.uint8)
    assert halved(image).tolist() == [[7, 105], [30, 7]]
    colour = np.random.default_rng(3).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    means = colour.reshape(20, 2, 30, 2, 3).mean(axis=(1, 3))
    assert np.abs(halved(colour) - means).max() <= 0.5


def test_a_frame_too_small_to_halve_names_its_own_size_and_the_way_out():
    small, enough = (frame_of(*np.zeros((2, rows, 80), np.uint8)) for rows in (30, 31))
    with pytest.raises(ValueError, match=r"Halve: images are 80x30, .* at least 31 px; .* such as paper"):
        Halve()(small)
    assert Match(disparities=8)(Halve()(enough)).pixels.shape == (16, 40)


@given(st.integers(1, 9), st.integers(1, 9), st.booleans(), st.booleans(), st.integers(0, 99))
def test_doubling_is_its_reference_at_any_size(rows, columns, odd_rows, odd_columns, seed):
    rng = np.random.default_rng(seed)
    small = rng.choice(np.array([3, 3.7, 20, np.nan], np.float32), (rows, columns))
    size = 2 * rows - odd_rows, 2 * columns - odd_columns
    assert doubled(small, *size).tobytes() == doubled_reference(small, *size).tobytes()
