"""Full size where a map gains from it: which rows that is, and that the others keep the disparities of half size."""

from dataclasses import replace

import numpy as np
import pytest

from stages import Halve, Match, PixelOrigin, Refine, StereoCamera, StereoFrame, Upsample
from stages.data.rows import disparity_rows, frame_rows, with_rows
from stages.matching.far_rows import far_rows
from stages.matching.kernels.row_ranges import count_in_rows, count_in_rows_reference
from tests.stages.builders import disparity_of

CAMERA = StereoCamera(fx=200, fy=200, cx=60, cy=48, baseline=0.2, width=120, height=96, cx_right=61)
SCALE = CAMERA.fx * CAMERA.baseline
RNG = np.random.default_rng(0)
IMAGE = RNG.integers(0, 256, (96, 140), np.uint8)
FRAME = StereoFrame(7, IMAGE[:, :120].copy(), IMAGE[:, 9:129].copy(), CAMERA)  # a wall: 9 px everywhere


def disparity(pixels, sigma=None, source=PixelOrigin.MEASURED):
    sigmas = None if sigma is None else np.full(pixels.shape, sigma, np.float32)
    return disparity_of(pixels, source * np.isfinite(pixels), stamp=7, camera=CAMERA, sigma=sigmas)


def ground(first_depth: float = 20.0, last_depth: float = 0.5) -> np.ndarray:
    """Disparities of a plane that falls to the camera: its inverse depth grows evenly from row to row."""
    inverse = np.linspace(1 / first_depth, 1 / last_depth, CAMERA.height)[:, None]
    return SCALE * inverse * np.ones(CAMERA.width) - (CAMERA.cx_right - CAMERA.cx)


@pytest.mark.parametrize(("max_step", "max_depth"), [(0.1, 8.0), (0.1, 0.0), (0.05, 4.0)])
def test_the_rows_end_where_a_pixel_of_half_size_is_a_fine_step_and_begin_where_the_map_does(max_step, max_depth):
    first, end = far_rows(disparity(ground()), CAMERA, max_step, max_depth)
    depth = SCALE / (ground()[:, 0] + 1)
    step = 2 * depth**2 / SCALE  # of 2 px, a pixel of half size
    assert first == (np.flatnonzero(depth < max_depth)[0] if max_depth else 0)
    assert step[end - 1] > max_step >= step[end]


def test_specks_and_guesses_move_no_limit_and_a_far_corner_does():
    pixels = ground()
    plain = far_rows(disparity(pixels), CAMERA, 0.1, 8.0)
    pixels[2, 5], pixels[90, 5] = 30, 3
    assert far_rows(disparity(pixels), CAMERA, 0.1, 8.0) == plain
    pixels[90, :40] = 3
    assert far_rows(disparity(pixels), CAMERA, 0.1, 0.0) == (0, 91)
    assert far_rows(disparity(ground(), source=PixelOrigin.FILLED), CAMERA, 0.1, 8.0) == (0, 0)


def test_counts_of_rows_equal_the_reference():
    rng = np.random.default_rng(0)
    pixels = rng.uniform(-2, 12, (9, 37)).astype(np.float32)
    pixels[rng.random(pixels.shape) < 0.2], pixels[4, 4], source = np.nan, np.inf, rng.integers(0, 4, pixels.shape)
    given = pixels, source.astype(np.uint8), np.float32(7), np.float32(3)
    np.testing.assert_array_equal(count_in_rows(*given), count_in_rows_reference(*given))


@pytest.mark.parametrize("pixels", [ground(1.0), ground(100, 50), np.full((96, 120), np.nan)],
                         ids=["all near", "all beyond", "unknown"])  # fmt: skip
def test_a_match_of_a_frame_without_such_rows_keeps_nearly_all_of_the_prior(pixels):
    found = Match(disparities=16, max_prior_step=0.1, max_prior_depth=8.0)(FRAME, disparity(pixels, 0.5))
    assert np.isnan(found.sigma).all(axis=1).sum() == 16  # the fewest that can be matched
    assert np.array_equal(found.pixels[16:], pixels[16:].astype(np.float32), equal_nan=True)


def test_rows_are_matched_and_refined_as_a_frame_of_their_own_and_the_others_kept():
    prior = disparity(ground(), sigma=0.5)
    matcher, refiner = Match(disparities=32, prior_weight=0, max_speckle_size=0), Refine()
    first, end = far_rows(prior, CAMERA, 0.1, 8.0)
    part = frame_rows(FRAME, first, end)
    assert vars(part.camera) == vars(replace(CAMERA, cy=CAMERA.cy - first, height=end - first))
    alone = matcher(part, disparity_rows(prior, first, end))
    found = replace(matcher, max_prior_step=0.1, max_prior_depth=8.0, keep_costs=True)(FRAME, prior)
    assert np.array_equal(found.pixels[first:end], alone.pixels, equal_nan=True)
    assert np.nanmedian(found.pixels[first:end]) == pytest.approx(9, abs=0.1)
    refined, refined_alone = refiner(FRAME, found), refiner(part, alone)
    others = np.r_[:first, end : CAMERA.height]
    for name in ("pixels", "source", "confidence"):
        whole, rows, old = (getattr(item, name) for item in (refined, refined_alone, prior))
        assert np.array_equal(whole[first:end], rows, equal_nan=True), name
        assert np.array_equal(whole[others], old[others]), name
    assert (found.costs[:, others] == 255).all()
    assert (found.costs[0, first:end] < 255).any()
    assert (refined.sigma[others] == 0.5).all()
    assert np.array_equal(refined.sigma[first:end], refined_alone.sigma, equal_nan=True)
    assert (refined.segments[others] == -1).all()
    assert np.array_equal(refined.segments[first:end], refined_alone.segments)


def test_a_refined_disparity_is_refined_again_as_a_whole():
    once = Refine()(FRAME, Match(disparities=32)(FRAME))
    assert once.sigma is not None
    again = Refine()(FRAME, replace(once, sigma=None))
    assert np.array_equal(Refine()(FRAME, once).pixels, again.pixels, equal_nan=True)


def test_a_layer_that_only_one_part_has_is_unknown_in_the_other():
    whole, part = disparity(ground()), disparity(np.ones((40, 120)), sigma=0.25)
    joined = with_rows(whole, 20, part)
    assert np.array_equal(np.isnan(joined.sigma[:, 0]), (np.arange(96) < 20) | (np.arange(96) >= 60))
    assert joined.segments is None
    assert with_rows(whole, 20, replace(part, sigma=None)).sigma is None


def test_an_enlarged_sigma_is_double_as_the_disparity_is():
    half = Halve()(FRAME)
    small = Refine()(half, Match(disparities=16)(half))
    large = Upsample(keep_sigma=True)(FRAME, small)
    assert np.array_equal(large.sigma[1::2, ::2], 2 * small.sigma)
    assert Upsample()(FRAME, small).sigma is None
