"""Matching: right on a synthetic truth, silent where there is no evidence, the same bits on any threads and memory."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recordings.simulator import Simulation
from recordings.simulator.ground_truth import true_disparity
from stages.data import PixelOrigin, StereoFrame
from stages.matching.match import CONFIDENCES, LEADS, Match
from stages.matching.match_opencv import MatchOpenCV
from tests.bench.matching import scene_errors
from tests.conftest import data_folder
from tests.stages.builders import disparity_of
from tests.stages.matching.pairs import SLOPE, TRUTH, accuracy, check_view, digest, frame_of, same, slanted, textured

ROOT = Path(__file__).parents[3]
COLOURED = replace(SLOPE, left=np.dstack([SLOPE.left] * 3), right=np.dstack([SLOPE.right] * 3))
MATCHERS = Match(disparities=48), MatchOpenCV(disparities=48)


@pytest.mark.parametrize(("match", "border", "share", "largest"), [
    *((Match(disparities=48, paths=paths), 2, share, 0.11) for paths, share in ((4, 0.85), (8, 0.95))),
    *((MatchOpenCV(disparities=48, paths=paths, color=color), 0, 0.95, 0.15)
      for color in (False, True) for paths in (3, 5, 8)),
])  # fmt: skip
def test_a_slanted_plane_is_measured_to_a_fraction_of_a_pixel(match, border, share, largest):
    frame = COLOURED if getattr(match, "color", False) else SLOPE
    result = match(frame)
    known, error, wrong = accuracy(result.pixels, TRUTH, np.arange(320) >= TRUTH + border)
    assert known > share
    assert error < largest
    assert wrong < 0.01
    assert (result.stamp, result.camera) == (SLOPE.stamp, SLOPE.camera)


@pytest.mark.parametrize("search", [{}, {"search_radius": 4}])
def test_a_steep_slope_has_fewer_errors_where_the_cost_follows_it(search):
    frame, truth = slanted(height=60, near=50.0, far=8.0)  # 0.7 px a row
    noise = np.random.default_rng(0).normal(0, 25, frame.left.shape)
    frame = replace(frame, left=np.clip(frame.left + noise, 0, 255).astype(np.uint8))
    bad = {}
    for follow in (True, False):
        match = Match(disparities=64, prior_weight=0.1, follow_slopes=follow, **search)
        right = np.abs(match(frame, disparity_of(truth, stamp=frame.stamp)).pixels - truth) <= 0.5
        bad[follow] = (~right)[np.arange(320) >= truth + 2].mean()
    assert bad[True] < 0.8 * bad[False]


def test_disparities_are_not_drawn_to_whole_numbers():
    error = Match(disparities=48)(SLOPE).pixels - TRUTH
    part = (10 * (TRUTH % 1)).astype(int)
    bias = [np.nanmedian(error[(part == i) & (np.abs(error) < 1)]) for i in range(10)]
    assert np.abs(bias).max() < 0.06, bias


@pytest.mark.parametrize("near", [False, True])
def test_costs_are_kept_if_asked_for_and_change_nothing_else(near):
    prior = disparity_of(TRUTH) if near else None
    match = Match(disparities=48, search_radius=4 if near else 0)
    plain, kept = match(SLOPE, prior), replace(match, keep_costs=True)(SLOPE, prior)
    assert plain.costs is None
    assert kept.costs is not None
    assert same(plain, kept)
    lowest, next_lowest = kept.costs.astype(int)
    lead = np.round(np.interp(plain.confidence, CONFIDENCES, LEADS))
    known = plain.confidence > 0
    np.testing.assert_array_equal((next_lowest - lowest)[known], lead[known])


@pytest.mark.parametrize("match", MATCHERS)
def test_the_left_margin_is_matched_only_where_the_right_image_sees_it(match):
    pixels = match(SLOPE).pixels
    assert not (pixels > np.arange(320)).any()
    margin = np.s_[:, :48]
    visible, hidden = (np.arange(320) >= TRUTH + 3)[margin], (np.arange(320) < TRUTH - 3)[margin]
    assert np.isfinite(pixels[margin])[visible].mean() > 0.9
    assert np.isfinite(pixels[margin])[hidden].mean() < 0.05


def test_partners_outside_the_right_image_win_where_they_cost_little():
    visible = (np.arange(320) >= TRUTH + 3) & (np.arange(320) < 48)
    cheap, dear = (Match(disparities=48, unseen_cost=cost)(SLOPE).pixels[visible] for cost in (2, 59))
    assert np.isfinite(cheap).mean() < 0.5 < 0.9 < np.isfinite(dear).mean()


def test_a_range_that_starts_elsewhere_finds_the_same():
    inside = (TRUTH > 14) & (TRUTH < 30) & (np.arange(320) > 60)
    for minimum, disparities in ((12, 50), (-20, 70)):
        found = Match(disparities=disparities, min_disparity=minimum)(SLOPE)
        known, error, _ = accuracy(found.pixels, TRUTH, inside)
        assert known > 0.95
        assert error < 0.12


@pytest.mark.parametrize(("match", "largest"), [*zip(MATCHERS, (0.12, 0.15), strict=True)])
def test_a_negative_range_finds_points_beyond_infinity(match, largest):
    crossed = frame_of(SLOPE.left[:, ::-1].copy(), SLOPE.right[:, ::-1].copy())
    known, error, _ = accuracy(replace(match, min_disparity=-47)(crossed).pixels, -TRUTH[:, ::-1])
    assert known > 0.85
    assert error < largest


def test_what_lies_beyond_max_depth_is_neither_searched_nor_made_up():
    match = Match(disparities=48, max_depth=1.5)  # 20 px: fx * baseline is 30 px m
    prior = disparity_of(np.where(np.arange(320) >= TRUTH, TRUTH, np.nan))
    whole, result = Match(disparities=48)(SLOPE, prior).pixels, match(SLOPE, prior)
    visible, near = np.arange(320) >= TRUTH + 2, result.pixels
    assert np.nanmin(near) >= 20
    assert np.isnan(near[visible & (TRUTH < 17)]).all()
    within = visible & (TRUTH > 20)
    assert np.isfinite(near[within]).mean() > 0.95
    assert np.isfinite(near[within & (TRUTH < 21)]).mean() > 0.8
    assert not result.confidence[np.isnan(near)].any()
    beyond = result.source[(TRUTH < 18) & (np.arange(320) > 40)]
    assert (beyond == PixelOrigin.OUT_OF_RANGE).mean() > 0.5
    assert np.nanmedian(np.abs(near - whole)[within]) < 0.02
    # A camera whose principal points differ sees the same depth at another disparity.
    moved = replace(SLOPE, camera=replace(SLOPE.camera, cx_right=SLOPE.camera.cx + 5))
    assert 15 <= np.nanmin(match(moved).pixels) < 20


def test_what_is_nearer_than_the_range_is_unknown_or_the_priors():
    known = np.arange(320) >= TRUTH + 2
    prior = disparity_of(np.where(known, TRUTH, np.nan), confidence=0.7)
    bare, joined = Match(disparities=24)(SLOPE, prior), Match(disparities=24, out_of_range="prior")(SLOPE, prior)
    nearer = known & (TRUTH > 22.5)
    assert nearer.sum() > 1000
    assert (bare.source[known & (TRUTH > 26.5)] == PixelOrigin.OUT_OF_RANGE).all()
    np.testing.assert_array_equal(joined.pixels[known & (TRUTH > 26.5)], prior.pixels[known & (TRUTH > 26.5)])
    assert np.isfinite(joined.pixels[nearer]).all()  # the end of the range, where the search also loses some
    assert np.abs(joined.pixels - TRUTH)[nearer].max() < 1
    taken = nearer & np.isnan(bare.pixels)
    assert (joined.source[taken] == PixelOrigin.MEASURED).all()
    assert (joined.confidence[taken] == np.float32(0.7)).all()
    np.testing.assert_array_equal(joined.pixels[~taken & (TRUTH < 22)], bare.pixels[~taken & (TRUTH < 22)])
    guess = disparity_of(prior.pixels, PixelOrigin.FILLED)  # is no measurement
    assert np.nanmax(Match(disparities=24, out_of_range="prior")(SLOPE, guess).pixels) < 24.5


@pytest.mark.parametrize(("match", "border", "largest"), [*zip(MATCHERS, (2, 0), (0.12, 0.15), strict=True)])
def test_sixteen_bits_and_colour_match_like_eight_bits_and_gray(match, border, largest):
    deep = frame_of(SLOPE.left.astype(np.uint16) * 9 + 700, SLOPE.right.astype(np.uint16) * 9 + 700)
    assert same(match(COLOURED), match(SLOPE))
    pixels = match(deep).pixels
    assert np.isfinite(pixels)[np.arange(320) >= TRUTH + border].mean() > 0.95
    assert np.nanmedian(np.abs(pixels - TRUTH)) < largest


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("level", [0, 255])
@pytest.mark.parametrize("match", MATCHERS)
def test_a_uniform_image_has_no_disparity(dtype, level, match):
    image = np.full((64, 96), level, dtype)
    for minimum in (-9, 0, 7):
        result = replace(match, disparities=32, min_disparity=minimum)(frame_of(image, image))
        assert np.isnan(result.pixels).all()
        assert (result.source == PixelOrigin.BLANK).all()
        assert (result.confidence == 0).all()


@given(
    st.integers(16, 90), st.integers(16, 90), st.sampled_from([4, 8]), st.sampled_from([1, 13, 50, 64, 70, 96]),
    st.integers(-15, 15), st.integers(0, 99),
)  # fmt: skip
def test_any_size_and_range_gives_disparities_inside_both(h, w, paths, disparities, minimum, seed):
    left = textured(h, w, seed).astype(np.uint8)
    right = np.roll(left, -5, axis=1)
    match = Match(disparities=disparities, min_disparity=minimum, paths=paths)
    result = match(frame_of(left, right))
    known = check_view(result, minimum, minimum + disparities - 1)

    assert (result.confidence[known] > 0).all()
    assert same(result, replace(match, threads=2)(frame_of(left, right)))


@pytest.fixture
def known():
    """What a slope's prior may say, no better than within 2 px, where both cameras see it."""
    rough = TRUTH + np.random.default_rng(4).uniform(-2, 2, TRUTH.shape).astype(np.float32)
    rough[:, :50][TRUTH[:, :50] > np.arange(50) - 3] = np.nan
    return disparity_of(rough, PixelOrigin.FILLED)


@pytest.mark.parametrize("paths", [4, 8])
def test_near_a_prior_disparities_are_found_also_beyond_the_range(known, paths):
    near = Match(disparities=10, search_radius=4, paths=paths, prior_weight=0.0)
    found = near(SLOPE, known)
    guided = np.isfinite(known.pixels)
    assert np.isnan(found.pixels[~guided]).all()
    share, error, wrong = accuracy(found.pixels, TRUTH, guided)
    assert share > 0.9
    assert error < 0.11
    assert wrong < 0.01
    assert same(found, replace(near, threads=2)(SLOPE, known))
    assert same(found, replace(near, disparities=48, out_of_range="prior")(SLOPE, known))


def test_around_a_prior_nothing_is_found_beyond_the_farthest_of_interest(known):
    pixels = Match(search_radius=4, max_depth=1.5)(SLOPE, known).pixels  # 20 px
    assert np.nanmin(pixels) >= 20
    assert np.isnan(pixels[TRUTH < 15]).all()
    assert np.isfinite(pixels)[(TRUTH > 24) & np.isfinite(known.pixels)].mean() > 0.95


def test_the_bits_depend_neither_on_threads_nor_on_memory_nor_on_company():
    match = Match(disparities=48)
    alone = match(SLOPE)
    with ThreadPoolExecutor(3) as workers:
        others = list(workers.map(lambda stage: stage(SLOPE), [replace(match, threads=t) for t in (1, 2, 3, 2)]))
    # 200 rows of 320 * 64 bytes are 4 MB: stripes of 25 rows
    others += [replace(match, max_memory=1, threads=threads)(SLOPE) for threads in (1, 2)]
    assert all(same(other, alone) for other in others)


def test_turning_the_images_upside_down_turns_the_result():
    frame, _ = slanted(height=97, width=150)
    turned = Match(disparities=40)(frame_of(frame.left[::-1].copy(), frame.right[::-1].copy()))
    upright = {name: getattr(turned, name)[::-1] for name in ("pixels", "source", "confidence")}
    assert same(Match(disparities=40)(frame), replace(turned, **upright))


def test_a_prior_decides_where_the_images_do_not():
    stripes = np.tile(np.repeat(np.array([40, 200], np.uint8), 4), 40)  # repeats every 8 px
    image = np.tile(stripes, (80, 1))
    image = np.clip(image + textured(80, 320, 3) / 12 - 10, 0, 255).astype(np.uint8)
    frame = frame_of(image, np.roll(image, -16, axis=1))
    prior, unknown = (disparity_of(np.full((80, 320), value), PixelOrigin.MEASURED, 1) for value in (16, np.nan))
    plain, guided = Match(disparities=48)(frame), Match(disparities=48, prior_weight=4.0)(frame, prior)
    assert same(Match(disparities=48, prior_weight=4.0)(frame, unknown), plain)
    inner = np.s_[:, 60:300]
    right = np.abs(guided.pixels[inner] - 16) < 0.5
    assert right.mean() > 0.97
    assert right.mean() >= (np.abs(plain.pixels[inner] - 16) < 0.5).mean()
    assert guided.confidence[inner].mean() > plain.confidence[inner].mean()


def test_a_wrong_prior_does_not_overrule_the_images():
    pixels = Match(disparities=48)(SLOPE, disparity_of(TRUTH + 5)).pixels
    assert np.nanmedian(np.abs(pixels - TRUTH)) < 0.15


@pytest.mark.slow
def test_the_confidence_is_the_share_of_right_matches_on_simulated_terrain():
    simulation = Simulation(scene="gravel", frames=3, width=480, height=360)
    parts = []
    for index in range(simulation.frames):
        made, stamp = simulation.frame(index), simulation.stamp(index)
        result = Match(disparities=96)(StereoFrame(stamp, *made.images, simulation.camera))
        error = np.abs(result.pixels - true_disparity(simulation, stamp, made).pixels)
        parts.append((result.confidence[np.isfinite(error)], error[np.isfinite(error)] <= 1))
    confidence, right = map(np.concatenate, zip(*parts, strict=True))
    assert len(right) > 200_000
    assert right.mean() == pytest.approx(confidence.mean(), abs=0.05)
    doubtful = confidence < 0.8
    assert 0.4 < right[doubtful].mean() < 0.9 < right[~doubtful].mean()


@pytest.mark.parametrize(
    ("kind", "parameters", "message"),
    [
        (Match, {"p1": 100, "p2": 30}, "p2 must be above"),
        (Match, {"p2": 220}, "p2 must be at most 196"),
        (Match, {"paths": 5}, "must be one of 4, 8"),
        (Match, {"max_depth": "12m"}, "max_depth must be a number in m, not '12m'"),
        (Match, {"band_height": 16, "search_radius": 4}, r"band_height has no effect with Match.search_radius"),
        (MatchOpenCV, {"block_size": 4}, "block_size must be odd"),
        (MatchOpenCV, {"p1": 30.0}, "p2 must be above"),
        (MatchOpenCV, {"paths": 4}, "must be one of 3, 5, 8"),
        (MatchOpenCV, {"block_size": 9, "color": True}, "16 bits"),
    ],
)
def test_parameters_that_cannot_work_are_refused(kind, parameters, message):
    with pytest.raises(ValueError, match=message):
        kind(**parameters)


@pytest.mark.parametrize(("match", "inputs", "message"), [
    (Match(), (frame_of(*np.zeros((2, 15, 64), np.uint8)),), "64x15"),
    (MatchOpenCV(), (frame_of(*np.zeros((2, 20, 64), np.uint8)),), "64x20"),
    (Match(min_disparity=400), (SLOPE,), "320 px wide"),
    (Match(disparities=48, max_depth=0.5), (SLOPE,),
     "max_depth = 0.5 m leaves nothing.* 60 px, and 47 px is the largest"),
    (Match(search_radius=4), (SLOPE,), "search_radius = 4 px needs a `prior`"),
    (Match(band_height=16), (SLOPE,), r"Match\.band_height = 16 px needs a `prior`"),
    (Match(max_prior_step=0.1), (SLOPE,), r"Match\.max_prior_step = 0\.1 m needs a `prior`"),
    (Match(follow_slopes=True), (SLOPE,), "follow_slopes needs a `prior`"),
    (Match(), (SLOPE, TRUTH), r"prior must be a stages\.Disparity, not a ndarray"),
    (Match(), (SLOPE, disparity_of(TRUTH[:50])), r"prior has shape \(50, 320\)"),
])  # fmt: skip
def test_frames_that_cannot_be_matched_are_refused(match, inputs, message):
    with pytest.raises(ValueError, match=message):
        match(*inputs)


FEATURES = {
    "nehalem": "+sse,+sse2,+sse3,+ssse3,+sse4.1,+sse4.2,+popcnt,+cx16",
    "haswell": "+sse,+sse2,+sse3,+ssse3,+sse4.1,+sse4.2,+popcnt,+cx16,+avx,+avx2,+bmi,+bmi2,+fma,+lzcnt,+movbe,+f16c",
}


@pytest.mark.slow
@pytest.mark.parametrize("processor", ["haswell", "nehalem"])
def test_processors_without_avx512_give_the_same_bits(processor):
    command = [sys.executable, "-c", "from tests.stages.matching.pairs import digest; print(digest())"]
    environment = {**os.environ, "NUMBA_CPU_NAME": processor, "NUMBA_CPU_FEATURES": FEATURES[processor]}
    output = subprocess.check_output(command, cwd=ROOT, env=environment, stderr=subprocess.DEVNULL, text=True)
    assert output.strip() == digest()


def test_real_scenes_are_matched_better_than_by_opencv():
    found = scene_errors(data_folder("middlebury-q"))
    ours, theirs = found["Match"], found["OpenCV HH"]
    assert ours[0] < 0.6 * theirs[0]
    assert ours[1] > theirs[1] - 5
    assert ours[2] < 0.9 * theirs[2]
    assert ours[3] < 0.85 * theirs[3]


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("height", [24, 25, 26, 27])  # a stripe: 12 rows of 640 * 64 bytes: one half, both, none
def test_stripes_give_the_same_bits_when_the_halves_differ(height, threads):
    frame, _ = slanted(height=height, width=640)
    whole, stripes = (Match(disparities=64, max_memory=memory, threads=threads)(frame) for memory in (400, 1))
    assert same(stripes, whole)


def test_a_frame_larger_than_the_memory_is_matched_in_stripes():
    frame, truth = slanted(height=256, width=1024, near=500.0, far=450.0)
    error = np.abs(Match(disparities=512, max_memory=20)(frame).pixels - truth)
    assert (error[np.arange(1024) >= truth + 2] <= 1).mean() > 0.9
