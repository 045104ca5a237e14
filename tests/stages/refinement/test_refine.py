"""Refine: less noise than its matches, fills marked as such, unknown where there is no evidence."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
import pytest

from stages.data import PixelOrigin, StereoFrame
from stages.data import known as known_origin
from stages.refinement import refine as module
from stages.refinement.refine import MAX_EVEN_CONTRAST, Refine, _saturated
from tests.bench.refining import stage
from tests.stages.builders import disparity_of
from tests.stages.refinement.flat_scene import CAMERA, GRAY, HEIGHT, SHAPE, WIDTH, flat, matched


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
    matches = disparity_of(pixels, confidence=0.8 * np.isfinite(pixels), stamp=5, camera=CAMERA)
    return StereoFrame(5, image, right, CAMERA), matches, truth.astype(np.float32)


FRAME, MATCHES, TRUTH = box()


def test_noise_falls_and_holes_close_on_the_right_side_of_edges():
    refined = Refine(superpixels=200, min_superpixel_size=1)(FRAME, MATCHES)
    error = np.abs(refined.pixels - TRUTH)
    measured = np.isfinite(MATCHES.pixels)
    assert np.sqrt(np.mean(error[measured] ** 2)) < 0.5 * np.sqrt(np.mean((MATCHES.pixels - TRUTH)[measured] ** 2))
    occluded = np.s_[32:88, 36:58]
    assert np.isfinite(refined.pixels[occluded]).mean() > 0.95
    assert (error[occluded] > 2).mean() < 0.02  # never the box's disparity


def test_source_is_the_origin_of_every_pixel():
    refined = Refine(superpixels=200, min_superpixel_size=1, subpixel_radius=0, support=False)(FRAME, MATCHES)
    known, matched = np.isfinite(refined.pixels), np.isfinite(MATCHES.pixels)
    near = np.abs(refined.pixels - MATCHES.pixels) <= 0.5
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
def test_only_measured_pixels_are_matches(code):
    nowhere = Refine()(FRAME, replace(MATCHES, source=np.full(SHAPE, code, np.uint8)))
    assert (nowhere.source == PixelOrigin.UNKNOWN).all()
    assert np.isnan(nowhere.pixels).all()
    source, pixels, confidence = MATCHES.source.copy(), MATCHES.pixels.copy(), MATCHES.confidence.copy()
    source[10:40, 20:60], pixels[10:40, 20:60], confidence[10:40, 20:60] = code, 35, 1
    layers = (pixels, confidence), (np.where(source == code, np.nan, pixels), MATCHES.confidence)
    given, wanted = (Refine()(FRAME, disparity_of(d, source, trust, stamp=5)) for d, trust in layers)
    assert np.array_equal(given.pixels, wanted.pixels, equal_nan=True)
    assert np.array_equal(given.source, wanted.source)


@pytest.mark.parametrize("median", [0, 5])
def test_a_replaced_match_becomes_plane_with_less_confidence(median, monkeypatch):
    pixels = flat()
    pixels[60, 80] = 30
    with monkeypatch.context() as patch:
        patch.setattr(module, "MAX_CORRECTION", 1000.0)
        patch.setattr(module, "MIN_INLIER_SHARE", 0)
        replaced = Refine(plane_weight=1, median_size=median, support=False)(GRAY, matched(pixels))
    assert replaced.pixels[60, 80] == pytest.approx(8, abs=0.01)
    assert replaced.source[60, 80] == PixelOrigin.PLANE
    assert replaced.confidence[60, 80] < 0.85
    assert (replaced.source == PixelOrigin.MEASURED).sum() == HEIGHT * WIDTH - 1
    kept = Refine(median_size=median, bilateral_radius=0, edge_radius=0, support=False)(GRAY, matched(pixels))
    assert (kept.pixels[60, 80], kept.source[60, 80]) == (30, PixelOrigin.MEASURED)
    assert kept.confidence[60, 80] == np.float32(0.99)


def test_a_lone_match_has_no_median_and_stays(monkeypatch):
    monkeypatch.setattr(module, "MAX_CORRECTION", 1000.0)
    monkeypatch.setattr(module, "MIN_INLIER_SHARE", 1)
    pixels = flat(5.0)
    pixels[50:70, 60:100], pixels[60, 80] = np.nan, 20
    refine = Refine(fill=False, plane_fill=False, superpixels=1, min_superpixel_size=1, support=False)
    assert refine(GRAY, matched(pixels)).pixels[60, 80] == pytest.approx(20, abs=0.01)


def test_a_match_of_little_confidence_counts_as_unknown():
    pixels = flat()
    pixels[30:60, 40:80] = 40
    doubtful = pixels == 40
    lax, strict = (
        Refine(min_confidence=least, fill=False, plane_fill=False)(GRAY, matched(pixels, np.where(doubtful, 0.3, 1)))
        for least in (0.3, 0.31)
    )
    assert np.isfinite(lax.pixels).all()
    assert np.array_equal(np.isnan(strict.pixels), doubtful)


def test_matches_with_their_own_sigma_are_refined_as_others_are():
    empty = np.where(np.arange(HEIGHT)[:, None] < 20, np.float32(np.nan), MATCHES.pixels)  # rows of sky
    matches = disparity_of(empty, confidence=MATCHES.confidence, stamp=5, camera=CAMERA)
    sigma = np.where(np.isfinite(empty), np.float32(0.25), np.float32(np.nan))
    sigma[np.unravel_index(np.argmax(np.isfinite(empty)), empty.shape)] = np.nan  # one match without
    one, other = (Refine()(FRAME, each) for each in (matches, replace(matches, sigma=sigma)))
    assert one.pixels.tobytes() == other.pixels.tobytes()
    assert one.segments.tobytes() == other.segments.tobytes()


def test_matches_without_a_confidence_are_refused():
    with pytest.raises(ValueError, match="the confidence of matched pixels is NaN; a result log does not keep it"):
        Refine()(FRAME, replace(MATCHES, confidence=np.full(SHAPE, np.nan, np.float32)))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("bad", [np.inf, -np.inf, 1e30, -1e7])
def test_a_disparity_beyond_the_image_is_no_match(bad):
    pixels, holed = MATCHES.pixels.copy(), MATCHES.pixels.copy()
    pixels[100:104, 100:104], holed[100:104, 100:104] = bad, np.nan
    refined, wanted = (Refine()(FRAME, replace(MATCHES, pixels=given)) for given in (pixels, holed))
    assert np.array_equal(refined.pixels, wanted.pixels, equal_nan=True)


def test_nothing_is_invented_outside_the_right_image(monkeypatch):
    monkeypatch.setattr(module, "MAX_EXTRAPOLATION", 3)
    refined = Refine(superpixels=200, min_superpixel_size=1)(FRAME, MATCHES)
    assert np.isnan(refined.pixels[:, :12]).all()


def test_a_match_far_from_its_plane_is_not_overwritten():
    pixels, left, right = MATCHES.pixels.copy(), FRAME.left.copy(), FRAME.right.copy()
    stone = np.s_[100:106, 120:126]
    pixels[stone] = TRUTH[stone] + 6
    left[stone] = right[100:106, 99:105] = 130  # both images show the stone
    matches = disparity_of(pixels, confidence=0.8 * np.isfinite(pixels), stamp=5)
    refine = Refine(superpixels=60, min_superpixel_size=1, support=False)
    refined = refine(replace(FRAME, left=left, right=right), matches)
    assert np.abs(refined.pixels[stone] - TRUTH[stone] - 6).max() < 1


FIELDS = "pixels", "source", "confidence", "segments"


def bits(disparity):
    return [getattr(disparity, field).tobytes() for field in FIELDS]


@pytest.mark.parametrize(
    ("parameters", "min_valid"), [({"surface_size": 0, "superpixels": 200}, 0.6), ({"superpixels": 40}, 0.95)]
)
def test_the_stamp_decides_every_bit(parameters, min_valid, monkeypatch):
    monkeypatch.setattr(module, "MIN_VALID_SHARE", min_valid)
    # Of one draw another seed makes another plane; so sure of matches, only those of surfaces are accepted.
    refine = Refine(min_superpixel_size=1, hypotheses=1, **parameters)
    again, other = (refine(replace(FRAME, stamp=n), replace(MATCHES, stamp=n)) for n in (5, -6))
    first = refine(FRAME, MATCHES)
    assert bits(again) == bits(first)
    assert again.segments.max() > 30
    assert (again.stamp, again.camera) == (5, FRAME.camera)
    assert bits(other)[0] != bits(first)[0]
    assert bits(other)[3] == bits(first)[3]


def test_two_frames_at_once_on_two_threads_have_the_bits_of_one_alone():
    turned = replace(MATCHES, **{name: getattr(MATCHES, name)[::-1].copy() for name in FIELDS[:3]})
    upside_down = replace(FRAME, left=FRAME.left[::-1].copy(), right=FRAME.right[::-1].copy())
    jobs = [(FRAME, MATCHES), (upside_down, turned)] * 6
    one, two = (Refine(superpixels=200, min_superpixel_size=1, threads=threads) for threads in (1, 2))
    alone = [bits(one(*job)) for job in jobs[:2]]
    with ThreadPoolExecutor(2) as workers:
        together = [bits(result) for result in workers.map(lambda job: two(*job), jobs)]
    assert together == alone * 6
    assert alone[0] != alone[1]


# Without subpixel fit, median and planes nothing else smooths.
UNPLANED = {"superpixels": 200, "min_superpixel_size": 1, "plane_weight": 0, "plane_fill": False}
BARE = UNPLANED | {"subpixel_radius": 0, "median_size": 0, "fill": False, "support": False}


def test_the_bilateral_filter_removes_noise_and_keeps_the_step():
    raw, smooth = (Refine(bilateral_radius=radius, edge_radius=0, **BARE)(FRAME, MATCHES) for radius in (0, 3))
    known = np.isfinite(MATCHES.pixels)
    assert np.array_equal(raw.pixels, MATCHES.pixels, equal_nan=True)
    assert np.array_equal(np.isfinite(smooth.pixels), known)
    error = np.abs(smooth.pixels - TRUTH)[known]
    assert np.sqrt(np.mean(error**2)) < 0.4 * np.sqrt(np.mean((raw.pixels - TRUTH)[known] ** 2))
    assert error.max() < 1


def test_depth_edges_move_onto_image_edges():
    known = np.isfinite(MATCHES.pixels)
    moved = disparity_of(np.where(known, np.roll(TRUTH, 1, axis=1), np.nan), confidence=0.8 * known, stamp=5)
    wrong = []
    for radius in (0, 3):
        refined = Refine(bilateral_radius=0, edge_radius=radius, **BARE)(FRAME, moved)
        error = np.abs(refined.pixels - TRUTH)
        wrong.append(np.count_nonzero(error[known] > 1))
        assert np.array_equal(np.isfinite(refined.pixels), known)
        replaced = np.abs(refined.pixels - moved.pixels) > 0.5
        assert (refined.source[replaced] == PixelOrigin.PLANE).all()
    assert wrong[0] > 80
    assert wrong[1] < 0.1 * wrong[0]


def test_a_match_moves_to_its_median_where_that_is_near():
    pixels = flat()
    pixels[60, 80], pixels[60, 100] = 8.9, 11
    bare = {"plane_weight": 0, "surface_size": 0, "bilateral_radius": 0, "edge_radius": 0, "support": False}
    moved = Refine(median_size=5, **bare)(GRAY, matched(pixels))
    assert (moved.pixels[60, 80], moved.pixels[60, 100]) == (8, 11)


@pytest.mark.parametrize(
    "refine",
    [Refine(), stage("paper", "disparity"), Refine(fill=False, bilateral_radius=0, edge_radius=0, median_size=0)],
)
def test_a_frame_without_matches_stays_unknown(refine):
    refined = refine(FRAME, matched(flat(np.nan)))
    assert np.isnan(refined.pixels).all()
    assert (refined.source == PixelOrigin.UNKNOWN).all()


def test_pixels_that_stay_unknown_keep_the_reason_of_the_matcher():
    reasons = np.random.default_rng(8).integers(PixelOrigin.OUT_OF_VIEW, PixelOrigin.SKY, SHAPE).astype(np.uint8)
    known = np.isfinite(MATCHES.pixels)
    refined = Refine()(FRAME, replace(MATCHES, source=np.where(known, MATCHES.source, reasons)))
    unknown = np.isnan(refined.pixels)
    assert np.array_equal(refined.source[unknown], reasons[unknown])
    assert unknown.any()
    assert np.array_equal(refined.pixels, Refine()(FRAME, MATCHES).pixels, equal_nan=True)


def test_without_planes_no_superpixels_are_made():
    assert Refine(plane_weight=0, plane_fill=False)(FRAME, MATCHES).segments is None
    for parameters in ({"plane_weight": 0.0}, {"plane_fill": False}):
        assert Refine(superpixels=200, min_superpixel_size=1, **parameters)(FRAME, MATCHES).segments.max() > 100


def test_occluded_pixels_never_get_the_occluders_disparity(monkeypatch):
    monkeypatch.setattr(module, "MIN_INLIER_SHARE", 0)
    monkeypatch.setattr(module, "MIN_VALID_SHARE", 0)
    # one superpixel over all: its plane would be that of the box or of the ground, wherever there is no match
    refined = Refine(superpixels=12, min_superpixel_size=1)(FRAME, MATCHES)
    hidden = np.s_[32:88, 36:58]
    assert (refined.pixels[hidden] < 0.5 * (40 + TRUTH[hidden])).all()


def test_nothing_is_filled_above_the_uppermost_matches():
    pixels = flat()
    pixels[:60, 30:130] = np.nan  # a sky between two hills
    refined = Refine()(GRAY, matched(pixels))
    assert np.isnan(refined.pixels[:43, 46:114]).all()
    assert np.isfinite(refined.pixels[45:, 30:130]).all()


def test_matches_of_a_saturated_sky_do_not_count(monkeypatch):
    image, pixels = np.dstack([GRAY.left] * 3), flat()
    noise = np.random.default_rng(1).integers(0, 3, (50, WIDTH, 1), dtype=np.uint8)
    image[:50], pixels[:50] = noise + np.uint8([130, 235, 252]), 60
    sky, matches = StereoFrame(5, image, image, CAMERA), matched(pixels)
    with monkeypatch.context() as patched:
        patched.setattr(module, "MAX_EXTRAPOLATION", 5)
        refined = Refine()(sky, matches)
    assert (refined.source[:42] == PixelOrigin.SKY).all()
    assert np.isnan(refined.pixels[:42]).all()  # the last rows show the ground in their windows, and 5 px are margin
    assert (refined.pixels[50:] < 9).all()
    monkeypatch.setattr(module, "SATURATION_LEVEL", 256)
    assert (Refine()(sky, matches).pixels[:40] > 50).all()


@pytest.mark.parametrize("level", [4, -1])
def test_a_black_shadow_is_not_measured_by_the_lit_ground_around_it(monkeypatch, level):
    """The matches in it are noise near those around; without the limits they become MEASURED."""
    rng = np.random.default_rng(7)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (HEIGHT, WIDTH + 8)).astype(np.float32), (0, 0), 1.5)
    texture = (100 + 2 * (texture - texture.mean())).astype(np.uint8)
    left, right = texture[:, :WIDTH].copy(), texture[:, 8:].copy()
    for image, shift in ((left, 0), (right, 8)):
        image[40:80, 60 - shift : 100 - shift] = rng.integers(0, 4, (40, 40))
    monkeypatch.setattr(module, "BLACK_LEVEL", level)
    monkeypatch.setattr(module, "BLACK_SIGMAS", 3 if level > 0 else -1)
    source = Refine()(StereoFrame(5, left, right, CAMERA), matched(flat())).source
    shadow = source[40:80, 60:100]
    assert (shadow == PixelOrigin.MEASURED).any() == (level < 0)
    assert (shadow == PixelOrigin.FILLED).all() or level < 0
    assert (source[:30] == PixelOrigin.MEASURED).mean() > 0.8


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
    frame = StereoFrame(5, left, right, CAMERA)
    refined, fitted = (Refine(subpixel_radius=radius)(frame, matched(flat())) for radius in (0, 2))
    assert (refined.source[:50] == PixelOrigin.FILLED).all()
    assert refined.confidence[:50].max() < 0.75
    assert (refined.source[70:, 15:] == PixelOrigin.MEASURED).all()
    assert refined.pixels == pytest.approx(np.full(SHAPE, 8.0), abs=1e-4)
    # Nor when brightness has moved it. (In the first columns so little is compared that chance may bear it out.)
    assert (fitted.source[:50, 3:] == PixelOrigin.FILLED).all()
    assert (fitted.source[70:, 15:] == PixelOrigin.MEASURED).all()


def test_a_match_near_its_support_stays_as_it_was_matched():
    plain = BARE | {"support": True, "bilateral_radius": 0, "edge_radius": 0}
    moved, kept = (Refine(min_support_shift=shift, **plain)(FRAME, MATCHES).pixels for shift in (0.0, 0.2))
    shift = np.abs(moved - MATCHES.pixels)
    near, far = shift < 0.2, shift >= 0.2
    assert min(near.sum(), far.sum()) > 1000
    np.testing.assert_array_equal(kept[near], MATCHES.pixels[near])
    np.testing.assert_array_equal(kept[~near], moved[~near])
