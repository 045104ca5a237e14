"""RefinePaper: planes by RANSAC in scikit-image's superpixels, holes by WLS; the stamp decides every bit."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from stages.data import PixelOrigin, StereoCamera, StereoFrame
from stages.refinement.paper import RefinePaper
from tests.bench.refining import stage
from tests.stages.builders import disparity_of

SHAPE = HEIGHT, WIDTH = 90, 120
CAMERA = StereoCamera(300, 300, 60, 45, 0.1, WIDTH, HEIGHT)
TRUTH = (10 + 0.05 * np.arange(WIDTH) + 0.1 * np.arange(HEIGHT)[:, np.newaxis]).astype(np.float32)


def scene(stamp=5):
    """A frame of soft shading, and matches of a slanted plane with noise, outliers and a hole."""
    random = np.random.default_rng(3)
    image = (100 + 20 * np.sin(np.add.outer(np.arange(HEIGHT), np.arange(WIDTH)) / 40)).astype(np.uint8)
    pixels = TRUTH + random.normal(0, 0.1, SHAPE).astype(np.float32)
    pixels[random.random(SHAPE) < 0.1] = 40
    pixels[40:50, 60:70] = np.nan
    return StereoFrame(stamp, image, image, CAMERA), matched(pixels, stamp)


def matched(pixels, stamp=5):
    known = np.isfinite(pixels)
    return disparity_of(pixels, np.where(known, PixelOrigin.MEASURED, PixelOrigin.SPECKLE), 0.9 * known, stamp)


def bits(disparity):
    return tuple(getattr(disparity, name).tobytes() for name in ("pixels", "source", "confidence"))


FRAME, MATCHES = scene()


def test_planes_replace_noise_and_outliers():
    refined = RefinePaper(superpixels=30, median_size=0, bilateral_radius=0)(FRAME, MATCHES)
    known = np.isfinite(MATCHES.pixels)
    assert np.abs(refined.pixels - TRUTH)[known].max() < 0.5
    assert (refined.source[MATCHES.pixels == 40] == PixelOrigin.PLANE).all()
    near = known & (np.abs(refined.pixels - MATCHES.pixels) <= 1)
    assert (refined.source[near] == PixelOrigin.MEASURED).all()


def test_a_stamp_before_1970_is_one_as_any_other():
    assert np.isfinite(RefinePaper()(*scene(stamp=-1)).pixels).any()


def test_a_superpixel_with_few_matches_gets_no_plane():
    bare = RefinePaper(superpixels=1000, median_size=0, bilateral_radius=0)  # of 11 px
    known = np.isfinite(MATCHES.pixels)
    np.testing.assert_array_equal(bare(FRAME, MATCHES).pixels[known], MATCHES.pixels[known])


def test_holes_are_filled_and_marked():
    refined = RefinePaper(superpixels=30)(FRAME, MATCHES)
    hole = np.isnan(MATCHES.pixels)
    assert (refined.source[hole] == PixelOrigin.FILLED).all()
    assert np.abs(refined.pixels - TRUTH)[hole].max() < 1
    assert np.isfinite(refined.pixels).all()


def test_wls_weighs_matches_by_their_confidence():
    frame = StereoFrame(5, *np.full((2, *SHAPE), 100, np.uint8), CAMERA)
    pixels, refine = np.full(SHAPE, 8, np.float32), RefinePaper(median_size=0, bilateral_radius=0)
    pixels[:, 60:], pixels[:, 50:70] = 9, np.nan
    matches = matched(pixels)
    doubted = np.where(np.arange(WIDTH) >= 70, np.float32(0.3), matches.confidence)
    middle = [refine(frame, replace(matches, confidence=c)).pixels[45, 60] for c in (matches.confidence, doubted)]
    assert middle[0] == pytest.approx(8.5, abs=0.06)
    assert middle[1] < middle[0] - 0.1


def test_a_frame_without_matches_keeps_its_reasons_but_no_code_of_a_known_pixel():
    nothing = matched(np.full(SHAPE, np.nan, np.float32))
    planes_only = replace(MATCHES, source=np.full(SHAPE, PixelOrigin.PLANE, np.uint8))
    for given, code in ((nothing, PixelOrigin.SPECKLE), (planes_only, PixelOrigin.UNKNOWN)):
        refined = RefinePaper()(FRAME, given)
        assert np.isnan(refined.pixels).all()
        assert (refined.source == code).all()


def test_the_stamp_decides_every_bit_also_of_two_frames_at_once(monkeypatch):
    monkeypatch.setattr("stages.refinement.paper.TRIALS", 2)  # so few that chance decides
    refine = RefinePaper(superpixels=30)
    jobs = [scene(5), scene(6)] * 3
    alone = [bits(refine(*job)) for job in jobs[:2]]
    assert alone[0] != alone[1]
    with ThreadPoolExecutor(2) as workers:
        assert list(workers.map(lambda job: bits(refine(*job)), jobs)) == alone * 3


def test_the_pipeline_paper_refines_with_it():
    assert stage("paper", "disparity") == RefinePaper()
