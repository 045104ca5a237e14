"""Reasons: every pixel without a disparity has one, and it is the first thing that is wrong with the match."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages import Disparity, LeftRightCheck, Match, MatchOpenCV, PixelOrigin, known
from stages.data import Array
from tests.stages.matching.pairs import slanted_pair, textured

REASONS = range(PixelOrigin.OUT_OF_VIEW, PixelOrigin.BLANK + 1)


def share(disparity: Disparity, code: PixelOrigin, area: Array) -> float:
    return float((disparity.source == code)[area].mean())


def test_known_holds_for_one_code_and_for_an_image_of_codes() -> None:
    codes = np.array(list(PixelOrigin), np.uint8)
    expected = [code in (PixelOrigin.MEASURED, PixelOrigin.PLANE, PixelOrigin.FILLED) for code in PixelOrigin]
    assert known(codes).tolist() == [known(code) for code in PixelOrigin] == expected


@given(
    st.sampled_from([24, 48]), st.sampled_from([0, 5, 255]), st.sampled_from([0, 40]), st.sampled_from([0, 6]),
    st.sampled_from([0.0, 1.5]), st.booleans(), st.integers(0, 99),
)  # fmt: skip
def test_every_unknown_pixel_of_match_has_a_reason(disparities, uniqueness, speckles, radius, depth, guided, seed):
    frame, truth = slanted_pair(height=60, width=120)
    left = frame.left.copy()
    left[20:30, 50:80] = seed % 256
    left[40:50, 20:70] = textured(10, 50, seed).astype(np.uint8)
    coarse = np.where(np.random.default_rng(seed).random(truth.shape) < 0.9, truth, np.nan).astype(np.float32)
    origin = np.where(np.isnan(coarse), PixelOrigin.UNKNOWN, PixelOrigin.MEASURED).astype(np.uint8)
    prior = Disparity(frame.stamp, coarse, origin, np.ones(truth.shape, np.float32))
    match = Match(
        disparities=disparities, uniqueness=min(uniqueness, 254), max_speckle_size=speckles, max_depth=depth,
        search_radius=radius if guided else 0,
    )  # fmt: skip
    found = match(replace(frame, left=left), prior if guided else None)
    matched = np.isfinite(found.pixels)
    assert np.array_equal(known(found.source), matched)
    assert (found.source[matched] == PixelOrigin.MEASURED).all()
    assert np.isin(found.source[~matched], REASONS).all()


@pytest.fixture(scope="module")
def slope():
    return slanted_pair()


@pytest.mark.parametrize("stage", [Match(disparities=48), MatchOpenCV(disparities=48)])
def test_what_the_right_image_does_not_show_is_out_of_view(slope, stage):
    frame, truth = slope
    hidden = share(stage(frame), PixelOrigin.OUT_OF_VIEW, np.arange(320) < truth - 3)
    assert hidden > 0.5 or isinstance(stage, MatchOpenCV)  # which does not report the checks that failed
    assert share(stage(frame), PixelOrigin.OUT_OF_VIEW, np.arange(320) > truth + 3) == 0
    shifted = replace(stage, min_disparity=7)(frame)
    assert (shifted.source[:, :7] == PixelOrigin.OUT_OF_VIEW).all()


def test_the_reason_of_a_prior_passes_where_nothing_is_searched(slope):
    frame, truth = slope
    holed, origin = truth.copy(), np.ones(truth.shape, np.uint8)
    holed[50:70, 100:130], origin[50:70, 100:130] = np.nan, PixelOrigin.SPECKLE
    holed[90:99, 100:130], origin[90:99, 100:130] = np.nan, PixelOrigin.UNKNOWN
    found = Match(search_radius=4)(frame, Disparity(3, holed, origin, np.ones(truth.shape, np.float32)))
    assert (found.source[50:70, 100:130] == PixelOrigin.SPECKLE).all()
    assert (found.source[90:99, 100:130] == PixelOrigin.OUT_OF_RANGE).all()


def test_matches_that_a_stricter_uniqueness_check_rejects_are_not_unique(slope):
    frame, _ = slope
    lax, strict = (Match(disparities=48, uniqueness=limit, max_speckle_size=0)(frame) for limit in (0, 250))
    rejected = known(lax.source) & ~known(strict.source)
    assert rejected.mean() > 0.1
    assert share(strict, PixelOrigin.UNIQUENESS, rejected) == 1
    assert share(lax, PixelOrigin.UNIQUENESS, np.s_[:]) < 0.01


def test_a_patch_that_differs_between_the_images_fails_a_check(slope):
    frame, _ = slope
    spoiled = frame.right.copy()
    spoiled[60:120, 100:200] = textured(60, 100, seed=5).astype(np.uint8)
    spoiled = replace(frame, right=spoiled)
    found = Match(disparities=48, lr_tolerance=1)(spoiled)
    assert share(found, PixelOrigin.LEFT_RIGHT, np.s_[60:120, 130:220]) > 0.1
    assert share(found, PixelOrigin.SPECKLE, np.s_[60:120, 130:220]) > 0.1
    kept = Match(disparities=48, lr_tolerance=1, max_speckle_size=0)(spoiled)
    assert share(kept, PixelOrigin.SPECKLE, np.s_[:]) == 0
    assert share(MatchOpenCV(disparities=48)(spoiled), PixelOrigin.SPECKLE, np.s_[60:120, 130:220]) > 0.1


def test_a_blank_window_is_blank_whatever_the_paths_carry_into_it(slope):
    frame, _ = slope
    left = frame.left.copy()
    left[50:80, 150:200] = 255
    found = Match(disparities=48)(replace(frame, left=left))
    assert (found.source[52:78, 152:198] == PixelOrigin.BLANK).all()


def test_the_left_right_check_keeps_the_reasons_of_the_matcher():
    pixels = np.array([[np.nan, 5, 5, 5, 5, 5, 5, 5, 5, 5]], np.float32)
    source = np.where(np.isnan(pixels), PixelOrigin.SPECKLE, PixelOrigin.MEASURED).astype(np.uint8)
    trust = np.ones(pixels.shape, np.float32)
    backward = Disparity(1, np.full(pixels.shape, 9, np.float32), np.ones(pixels.shape, np.uint8), trust)
    checked = LeftRightCheck()(Disparity(1, pixels, source, trust), backward)
    assert checked.source[0].tolist() == [PixelOrigin.SPECKLE] + 4 * [1] + 5 * [PixelOrigin.LEFT_RIGHT]
