"""Refine: less noise than its matches, fills marked as such, unknown where there is no evidence."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
import pytest

from stages.data import Disparity, PixelOrigin, StereoCamera, StereoFrame
from stages.data import known as known_origin
from stages.refinement import refine as module
from stages.refinement.refine import MAX_EVEN_CONTRAST, Refine, _saturated
from tests.bench.stereo_scores import paper_stages
from tests.stages.refinement.flat_scene import HEIGHT, SHAPE, WIDTH, flat_scene


@pytest.fixture
def box():
    """A box 25 px before a slanted ground, its frame, noisy matches with holes and an occlusion, and the truth."""
    rng = np.random.default_rng(2)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    inside = (abs(y - 60) < 30) & (abs(x - 90) < 30)
    truth = np.where(inside, 40, 10 + 0.05 * y)
    gray = np.where(inside, 190, 70) + rng.integers(-6, 7, SHAPE)
    image = gray.astype(np.uint8)
    right = np.roll(image, -10, axis=1)  # texture where the left image has none
    for part in (~inside, inside):  # the nearer one last
        right[y[part], np.rint(x - truth).astype(int).clip(0)[part]] = image[part]
    pixels = (truth + rng.normal(0, 0.25, SHAPE)).astype(np.float32)
    pixels[rng.random(SHAPE) < 0.15] = np.nan
    pixels[30:90, 35:61] = np.nan  # hidden from the right camera, left of the box
    pixels[:, :15] = np.nan  # outside the right image
    source = np.where(np.isfinite(pixels), PixelOrigin.MEASURED, PixelOrigin.UNKNOWN).astype(np.uint8)
    confidence = np.where(np.isfinite(pixels), 0.8, 0).astype(np.float32)
    camera = StereoCamera(300, 300, 80, 60, 0.1, WIDTH, HEIGHT)
    frame = StereoFrame(5, image, right, camera)
    return frame, Disparity(5, pixels, source, confidence, camera=camera), truth.astype(np.float32)


def test_noise_falls_and_holes_close_on_the_right_side_of_edges(box):
    frame, matches, truth = box
    refined = Refine(superpixels=200, min_superpixel_size=1)(frame, matches)
    error = np.abs(refined.pixels - truth)
    measured = np.isfinite(matches.pixels)
    assert np.sqrt(np.mean(error[measured] ** 2)) < 0.5 * np.sqrt(np.mean((matches.pixels - truth)[measured] ** 2))
    occluded = np.s_[32:88, 36:58]
    assert np.isfinite(refined.pixels[occluded]).mean() > 0.95
    assert (error[occluded] > 2).mean() < 0.02  # never the box's disparity


def test_source_is_the_origin_of_every_pixel(box):
    frame, matches, _ = box
    refined = Refine(superpixels=200, min_superpixel_size=1, subpixel_radius=0, support=False)(frame, matches)
    known, matched = np.isfinite(refined.pixels), np.isfinite(matches.pixels)
    near = np.abs(refined.pixels - matches.pixels) <= 0.5
    assert near[matched].mean() > 0.9
    assert np.array_equal(refined.source == PixelOrigin.MEASURED, near)
    assert (refined.source[matched & ~near] == PixelOrigin.PLANE).all()
    assert np.array_equal(known_origin(refined.source), known)
    confidence = {code: refined.confidence[refined.source == code] for code in list(PixelOrigin)[:4]}
    # as calibrated: of matches by their own confidence, 0.8, and by whether a plane agrees
    assert np.unique(confidence[PixelOrigin.MEASURED]) == pytest.approx([0.926, 0.994], abs=0.002)
    assert np.unique(confidence[PixelOrigin.PLANE]) == pytest.approx([0.79, 0.81])
    assert set(np.unique(confidence[PixelOrigin.FILLED])) <= {np.float32(0.72), np.float32(0.66)}
    assert (confidence[PixelOrigin.UNKNOWN] == 0).all()
    assert all(part.size for part in confidence.values())


@pytest.mark.parametrize("code", [PixelOrigin.UNKNOWN, PixelOrigin.PLANE, PixelOrigin.FILLED])
def test_only_measured_pixels_are_matches(box, code):
    frame, matches, _ = box
    nowhere = Refine()(frame, replace(matches, source=np.full(SHAPE, code, np.uint8)))
    assert (nowhere.source == PixelOrigin.UNKNOWN).all()
    assert np.isnan(nowhere.pixels).all()
    source, pixels, confidence = matches.source.copy(), matches.pixels.copy(), matches.confidence.copy()
    source[10:40, 20:60], pixels[10:40, 20:60], confidence[10:40, 20:60] = code, 35, 1
    holed = replace(matches, pixels=np.where(source == code, np.nan, pixels).astype(np.float32), source=source)
    given, wanted = (Refine()(frame, d) for d in (replace(holed, pixels=pixels, confidence=confidence), holed))
    assert np.array_equal(given.pixels, wanted.pixels, equal_nan=True)
    assert np.array_equal(given.source, wanted.source)


@pytest.mark.parametrize("median", [0, 5])
def test_a_replaced_match_becomes_plane_with_less_confidence(median, monkeypatch):
    frame, pixels, source, confidence = flat_scene()
    pixels[60, 80] = 30
    matches = Disparity(5, pixels, source, confidence)
    with monkeypatch.context() as patch:
        patch.setattr(module, "MAX_CORRECTION", 1000.0)
        patch.setattr(module, "MIN_INLIER_SHARE", 0)
        replaced = Refine(plane_weight=1, median_size=median, support=False)(frame, matches)
    assert replaced.pixels[60, 80] == pytest.approx(8, abs=0.01)
    assert replaced.source[60, 80] == PixelOrigin.PLANE
    assert replaced.confidence[60, 80] < 0.85
    assert (replaced.source == PixelOrigin.MEASURED).sum() == HEIGHT * WIDTH - 1
    kept = Refine(median_size=median, bilateral_radius=0, edge_radius=0, support=False)(frame, matches)
    assert (kept.pixels[60, 80], kept.source[60, 80]) == (30, PixelOrigin.MEASURED)
    assert kept.confidence[60, 80] == np.float32(0.99)


def test_a_lone_match_has_no_median_and_stays(monkeypatch):
    monkeypatch.setattr(module, "MAX_CORRECTION", 1000.0)
    monkeypatch.setattr(module, "MIN_INLIER_SHARE", 1)
    frame, pixels, source, confidence = flat_scene(5.0)
    pixels[50:70, 60:100], source[50:70, 60:100] = np.nan, 0
    pixels[60, 80], source[60, 80] = 20, 1
    refine = Refine(fill=False, plane_fill=False, superpixels=1, min_superpixel_size=1, support=False)
    refined = refine(frame, Disparity(5, pixels, source, confidence))
    assert refined.pixels[60, 80] == pytest.approx(20, abs=0.01)


def test_a_match_of_little_confidence_counts_as_unknown():
    frame, pixels, source, confidence = flat_scene()
    pixels[30:60, 40:80], confidence[30:60, 40:80] = 40, 0.3
    matches = Disparity(5, pixels, source, confidence)
    bare = {"fill": False, "plane_fill": False}
    doubted = Refine(min_confidence=0.31, **bare)(frame, matches)
    assert np.array_equal(np.isnan(doubted.pixels), confidence < 0.31)
    assert np.isfinite(Refine(min_confidence=0.3, **bare)(frame, matches).pixels).all()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("bad", [np.inf, -np.inf, 1e30, -1e7])
def test_a_disparity_beyond_the_image_is_no_match(box, bad):
    frame, matches, _ = box
    pixels, holed = matches.pixels.copy(), matches.pixels.copy()
    pixels[100:104, 100:104], holed[100:104, 100:104] = bad, np.nan
    refined, wanted = (Refine()(frame, replace(matches, pixels=given)) for given in (pixels, holed))
    assert np.array_equal(refined.pixels, wanted.pixels, equal_nan=True)


def test_nothing_is_invented_outside_the_right_image(box, monkeypatch):
    monkeypatch.setattr(module, "MAX_EXTRAPOLATION", 3)
    frame, matches, _ = box
    refined = Refine(superpixels=200, min_superpixel_size=1)(frame, matches)
    assert np.isnan(refined.pixels[:, :12]).all()


def test_a_match_far_from_its_plane_is_not_overwritten(box):
    frame, matches, truth = box
    pixels, source, confidence = (np.copy(a) for a in (matches.pixels, matches.source, matches.confidence))
    stone = np.s_[100:106, 120:126]
    pixels[stone], source[stone], confidence[stone] = truth[stone] + 6, PixelOrigin.MEASURED, 0.8
    matches = replace(matches, pixels=pixels, source=source, confidence=confidence)
    left, right = frame.left.copy(), frame.right.copy()
    left[stone] = right[100:106, 99:105] = 130  # both images show the stone
    frame = replace(frame, left=left, right=right)
    refined = Refine(superpixels=60, min_superpixel_size=1, support=False)(frame, matches)
    assert np.abs(refined.pixels[stone] - truth[stone] - 6).max() < 1


FIELDS = "pixels", "source", "confidence", "segments"


def bits(disparity):
    return [getattr(disparity, field).tobytes() for field in FIELDS]


@pytest.mark.parametrize(
    ("parameters", "min_valid"), [({"surface_size": 0, "superpixels": 200}, 0.6), ({"superpixels": 40}, 0.95)]
)
def test_the_stamp_decides_every_bit(box, parameters, min_valid, monkeypatch):
    monkeypatch.setattr(module, "MIN_VALID_SHARE", min_valid)
    frame, matches, _ = box
    # Of one draw another seed makes another plane; so sure of matches, only those of surfaces are accepted.
    refine = Refine(min_superpixel_size=1, hypotheses=1, **parameters)
    again, other = (refine(replace(frame, stamp=n), replace(matches, stamp=n)) for n in (5, -6))
    first = refine(frame, matches)
    assert bits(again) == bits(first)
    assert again.segments.max() > 30
    assert (again.stamp, again.camera) == (5, frame.camera)
    assert bits(other)[0] != bits(first)[0]
    assert bits(other)[3] == bits(first)[3]


def test_two_frames_at_once_on_two_threads_have_the_bits_of_one_alone(box):
    frame, matches, _ = box
    turned = replace(matches, **{name: getattr(matches, name)[::-1].copy() for name in FIELDS[:3]})
    upside_down = replace(frame, left=frame.left[::-1].copy(), right=frame.right[::-1].copy())
    jobs = [(frame, matches), (upside_down, turned)] * 6
    one, two = (Refine(superpixels=200, min_superpixel_size=1, threads=threads) for threads in (1, 2))
    alone = [bits(one(*job)) for job in jobs[:2]]
    with ThreadPoolExecutor(2) as workers:
        together = [bits(result) for result in workers.map(lambda job: two(*job), jobs)]
    assert together == alone * 6
    assert alone[0] != alone[1]


# Without subpixel fit, median and planes nothing else smooths.
UNPLANED = {"superpixels": 200, "min_superpixel_size": 1, "plane_weight": 0, "plane_fill": False}
BARE = UNPLANED | {"subpixel_radius": 0, "median_size": 0, "fill": False, "support": False}


def test_the_bilateral_filter_removes_noise_and_keeps_the_step(box):
    frame, matches, truth = box
    raw, smooth = (Refine(bilateral_radius=radius, edge_radius=0, **BARE)(frame, matches) for radius in (0, 3))
    known = np.isfinite(matches.pixels)
    assert np.array_equal(raw.pixels, matches.pixels, equal_nan=True)
    assert np.array_equal(np.isfinite(smooth.pixels), known)
    error = np.abs(smooth.pixels - truth)[known]
    assert np.sqrt(np.mean(error**2)) < 0.4 * np.sqrt(np.mean((raw.pixels - truth)[known] ** 2))
    assert error.max() < 1


def test_depth_edges_move_onto_image_edges(box):
    frame, matches, truth = box
    known = np.isfinite(matches.pixels)
    moved = replace(matches, pixels=np.where(known, np.roll(truth, 1, axis=1), np.nan).astype(np.float32))
    wrong = []
    for radius in (0, 3):
        refined = Refine(bilateral_radius=0, edge_radius=radius, **BARE)(frame, moved)
        error = np.abs(refined.pixels - truth)
        wrong.append(np.count_nonzero(error[known] > 1))
        assert np.array_equal(np.isfinite(refined.pixels), known)
        replaced = np.abs(refined.pixels - moved.pixels) > 0.5
        assert (refined.source[replaced] == PixelOrigin.PLANE).all()
    assert wrong[0] > 80
    assert wrong[1] < 0.1 * wrong[0]


def test_a_match_moves_to_its_median_where_that_is_near():
    frame, pixels, source, confidence = flat_scene()
    pixels[60, 80], pixels[60, 100] = 8.9, 11
    bare = {"plane_weight": 0, "surface_size": 0, "bilateral_radius": 0, "edge_radius": 0, "support": False}
    moved = Refine(median_size=5, **bare)(frame, Disparity(5, pixels, source, confidence))
    assert (moved.pixels[60, 80], moved.pixels[60, 100]) == (8, 11)


@pytest.mark.parametrize(
    "refine", [Refine(), paper_stages()[1], Refine(fill=False, bilateral_radius=0, edge_radius=0, median_size=0)]
)
def test_a_frame_without_matches_stays_unknown(box, refine):
    frame, matches, _ = box
    empty = np.full(SHAPE, np.nan, np.float32)
    nothing = replace(matches, pixels=empty, source=np.zeros(SHAPE, np.uint8), confidence=np.zeros(SHAPE, np.float32))
    refined = refine(frame, nothing)
    assert np.isnan(refined.pixels).all()
    assert (refined.source == PixelOrigin.UNKNOWN).all()


def test_pixels_that_stay_unknown_keep_the_reason_of_the_matcher(box):
    frame, matches, _ = box
    reasons = np.random.default_rng(8).integers(PixelOrigin.OUT_OF_VIEW, PixelOrigin.SKY, SHAPE).astype(np.uint8)
    matched = np.isfinite(matches.pixels)
    refined = Refine()(frame, replace(matches, source=np.where(matched, matches.source, reasons)))
    unknown = np.isnan(refined.pixels)
    assert np.array_equal(refined.source[unknown], reasons[unknown])
    assert unknown.any()
    assert np.array_equal(refined.pixels, Refine()(frame, matches).pixels, equal_nan=True)


def test_without_planes_no_superpixels_are_made(box):
    frame, matches, _ = box
    assert Refine(plane_weight=0, plane_fill=False)(frame, matches).segments is None
    for parameters in ({"plane_weight": 0.0}, {"plane_fill": False}):
        assert Refine(superpixels=200, min_superpixel_size=1, **parameters)(frame, matches).segments.max() > 100


def test_occluded_pixels_never_get_the_occluders_disparity(box, monkeypatch):
    monkeypatch.setattr(module, "MIN_INLIER_SHARE", 0)
    monkeypatch.setattr(module, "MIN_VALID_SHARE", 0)
    frame, matches, truth = box
    # one superpixel over all: its plane would be that of the box or of the ground, wherever there is no match
    refined = Refine(superpixels=12, min_superpixel_size=1)(frame, matches)
    hidden = np.s_[32:88, 36:58]
    assert (refined.pixels[hidden] < 0.5 * (40 + truth[hidden])).all()


def test_nothing_is_filled_above_the_uppermost_matches():
    frame, pixels, source, confidence = flat_scene()
    pixels[:60, 30:130], source[:60, 30:130] = np.nan, 0  # a sky between two hills
    refined = Refine()(frame, Disparity(5, pixels, source, confidence))
    assert np.isnan(refined.pixels[:43, 46:114]).all()
    assert np.isfinite(refined.pixels[45:, 30:130]).all()


def test_matches_of_a_saturated_sky_do_not_count(monkeypatch):
    frame, pixels, source, confidence = flat_scene()
    image = np.dstack([frame.left] * 3)
    image[:50] = (130, 235, 252)
    noise = np.random.default_rng(1).integers(0, 3, (50, WIDTH, 1), dtype=np.uint8)
    image[:50] += noise
    pixels[:50] = 60
    sky = StereoFrame(5, image, image, frame.camera)
    with monkeypatch.context() as patched:
        patched.setattr(module, "MAX_EXTRAPOLATION", 5)
        refined = Refine()(sky, Disparity(5, pixels, source, confidence))
    assert (refined.source[:42] == PixelOrigin.SKY).all()
    assert np.isnan(refined.pixels[:42]).all()  # the last rows show the ground in their windows, and 5 px are margin
    assert (refined.pixels[50:] < 9).all()
    monkeypatch.setattr(module, "SATURATION_LEVEL", 256)
    assert (Refine()(sky, Disparity(5, pixels, source, confidence)).pixels[:40] > 50).all()


def test_even_patches_that_are_bright_in_a_colour_are_saturated():
    image = cv2.blur(np.random.default_rng(3).integers(0, 256, (97, 60, 3), dtype=np.uint8), (9, 9))
    image[24:72, 10:] = 253
    guide = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    even = cv2.morphologyEx(guide, cv2.MORPH_GRADIENT, np.ones((5, 5), np.uint8)) <= MAX_EVEN_CONTRAST
    np.testing.assert_array_equal(_saturated(image, guide, 250), even & (image >= 250).any(axis=2))
    assert not _saturated(image.astype(np.uint16), guide, 250).any()


def test_a_match_without_correlation_becomes_filled():
    """Texture below, noise above: only the lower half of the images correlates at the common disparity."""
    rng = np.random.default_rng(11)
    texture = rng.integers(60, 140, (HEIGHT, WIDTH + 8)).astype(np.uint8)
    left, right = texture[:, :WIDTH].copy(), texture[:, 8:].copy()
    left[:60], right[:60] = rng.integers(98, 103, (2, 60, WIDTH))
    frame = StereoFrame(5, left, right, StereoCamera(300, 300, 80, 60, 0.1, WIDTH, HEIGHT))
    _, pixels, source, confidence = flat_scene()
    refined, fitted = (Refine(subpixel_radius=r)(frame, Disparity(5, pixels, source, confidence)) for r in (0, 2))
    assert (refined.source[:50] == PixelOrigin.FILLED).all()
    assert refined.confidence[:50].max() < 0.75
    assert (refined.source[70:, 15:] == PixelOrigin.MEASURED).all()
    assert refined.pixels == pytest.approx(np.full(SHAPE, 8.0), abs=1e-4)
    # Nor when brightness has moved it. (In the first columns so little is compared that chance may bear it out.)
    assert (fitted.source[:50, 3:] == PixelOrigin.FILLED).all()
    assert (fitted.source[70:, 15:] == PixelOrigin.MEASURED).all()


def test_a_match_near_its_support_stays_as_it_was_matched(box):
    frame, matches, _ = box
    plain = BARE | {"support": True, "bilateral_radius": 0, "edge_radius": 0}
    moved, kept = (Refine(min_support_shift=shift, **plain)(frame, matches).pixels for shift in (0.0, 0.2))
    shift = np.abs(moved - matches.pixels)
    near, far = shift < 0.2, shift >= 0.2
    assert min(near.sum(), far.sum()) > 1000
    np.testing.assert_array_equal(kept[near], matches.pixels[near])
    np.testing.assert_array_equal(kept[~near], moved[~near])
