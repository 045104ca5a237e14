"""Refinement: better than the matches it is given, honest about what it filled, and silent where nothing is known."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages.data import Disparity, Source, StereoCamera, StereoFrame
from stages.kernels.background import fill_background
from stages.match import Match
from stages.match_opencv import MatchOpenCV
from stages.refine import Refine
from tests.bench.stereo_scores import PAPER_MATCH, PAPER_REFINE, errors, load_scene

SHAPE = HEIGHT, WIDTH = 120, 160


@pytest.fixture
def box():
    """A box 25 px before a slanted ground, its frame, noisy matches with holes and an occlusion, and the truth."""
    rng = np.random.default_rng(2)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    inside = (abs(y - 60) < 30) & (abs(x - 90) < 30)
    truth = np.where(inside, 40, 10 + 0.05 * y)
    gray = np.where(inside, 190, 70) + rng.integers(-6, 7, SHAPE)
    image = gray.astype(np.uint8)
    pixels = (truth + rng.normal(0, 0.25, SHAPE)).astype(np.float32)
    pixels[rng.random(SHAPE) < 0.15] = np.nan
    pixels[30:90, 35:61] = np.nan  # hidden from the right camera, left of the box
    pixels[:, :15] = np.nan  # outside the right image
    source = np.where(np.isfinite(pixels), Source.MEASURED, Source.UNKNOWN).astype(np.uint8)
    confidence = np.where(np.isfinite(pixels), 0.8, 0).astype(np.float32)
    camera = StereoCamera(300, 300, 80, 60, 0.1, WIDTH, HEIGHT)
    frame = StereoFrame(5, image, image, camera)
    return frame, Disparity(5, pixels, source, confidence, camera=camera), truth.astype(np.float32)


@pytest.mark.parametrize("parameters", [{}, {"fill": "wls"}])
def test_noise_falls_and_holes_close_on_the_right_side_of_edges(box, parameters):
    frame, matches, truth = box
    refined = Refine(superpixels=200, **parameters)(frame, matches)
    error = np.abs(refined.pixels - truth)
    measured = np.isfinite(matches.pixels)
    assert np.sqrt(np.mean(error[measured] ** 2)) < 0.5 * np.sqrt(np.mean((matches.pixels - truth)[measured] ** 2))
    occluded = np.s_[32:88, 36:58]
    assert np.isfinite(refined.pixels[occluded]).mean() > 0.95
    assert (error[occluded] > 2).mean() < 0.02  # never the box's disparity


def test_every_pixel_says_where_it_comes_from(box):
    frame, matches, _ = box
    refined = Refine(superpixels=200)(frame, matches)
    known = np.isfinite(refined.pixels)
    assert np.array_equal(refined.source == Source.MEASURED, matches.source == Source.MEASURED)
    assert np.array_equal(refined.source == Source.UNKNOWN, ~known)
    confidence = {code: refined.confidence[refined.source == code] for code in Source}
    assert (confidence[Source.MEASURED] == np.float32(0.8)).all()
    assert 0.3 < confidence[Source.PLANE].min() <= confidence[Source.PLANE].max() <= 0.5
    assert 0 < confidence[Source.FILLED].min() <= confidence[Source.FILLED].max() <= 0.25
    assert (confidence[Source.UNKNOWN] == 0).all()
    assert all(part.size for part in confidence.values())


def test_nothing_is_invented_outside_the_right_image(box):
    frame, matches, _ = box
    assert np.isnan(Refine(superpixels=200)(frame, matches).pixels[:, :12]).all()


def test_a_match_far_from_its_plane_is_not_overwritten(box):
    frame, matches, truth = box
    pixels, confidence = matches.pixels.copy(), matches.confidence.copy()
    stone = np.s_[100:106, 120:126]
    pixels[stone], confidence[stone] = truth[stone] + 6, 0.8
    refined = Refine(superpixels=60)(frame, replace(matches, pixels=pixels, confidence=confidence))
    assert np.abs(refined.pixels[101:105, 121:125] - truth[101:105, 121:125] - 6).max() < 1


def test_the_stamp_decides_every_bit(box):
    frame, matches, _ = box
    runs = [Refine(superpixels=200)(frame, matches) for _ in range(2)]
    for field in ("pixels", "source", "confidence", "segments"):
        assert getattr(runs[0], field).tobytes() == getattr(runs[1], field).tobytes()
    assert runs[0].segments.max() > 100
    assert (runs[0].stamp, runs[0].camera) == (5, frame.camera)


@pytest.mark.parametrize(
    "refine", [Refine(), Refine(**PAPER_REFINE), Refine(fill="none", bilateral_radius=0, median=0)]
)
def test_no_match_at_all_stays_no_disparity(box, refine):
    frame, matches, _ = box
    empty = np.full(SHAPE, np.nan, np.float32)
    nothing = replace(matches, pixels=empty, source=np.zeros(SHAPE, np.uint8), confidence=np.zeros(SHAPE, np.float32))
    refined = refine(frame, nothing)
    assert np.isnan(refined.pixels).all()
    assert (refined.source == Source.UNKNOWN).all()


def test_a_disparity_of_another_size_is_refused(box):
    frame, matches, _ = box
    small = Disparity(5, matches.pixels[:50], matches.source[:50], matches.confidence[:50])
    with pytest.raises(ValueError, match=r"\(50, 160\)"):
        Refine()(frame, small)


def test_rover_beats_matching_and_paper_on_real_scenes():
    folder = Path(os.environ.get("ROVERFLOW_DATA", "")) / "middlebury-q"
    if not folder.is_dir():
        pytest.skip("ROVERFLOW_DATA names no folder with middlebury-q")
    scores = []
    for name in ("Adirondack", "Motorcycle", "PlaytableP", "Teddy"):
        frame, truth, mask, levels = load_scene(folder / name)
        matches = Match(disparities=levels)(frame)
        paper = Refine(**PAPER_REFINE)(frame, MatchOpenCV(disparities=levels, **PAPER_MATCH)(frame))
        chain = fill_background(matches.pixels, np.inf), paper.pixels, Refine()(frame, matches).pixels
        scores.append([errors(pixels, truth, mask, levels) for pixels in chain])
    matched, paper, rover = np.mean(scores, axis=0)
    fine = [0, 1, 3, 4]  # bad-0.5 and bad-1 of both areas; fewer than Match's are the errors beyond 2 px only in RMS
    assert (rover[fine] < 0.97 * matched[fine]).all()
    assert rover[6] < matched[6]
    assert (rover[:7] < 0.97 * paper[:7]).all()
    assert rover[7] > 98
