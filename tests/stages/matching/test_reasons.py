"""Reasons: every pixel without a disparity has one, and it is the first thing that is wrong with the match."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages import LeftRightCheck, Match, MatchOpenCV, PixelOrigin, known
from tests.stages.builders import disparity_of
from tests.stages.matching.pairs import SLOPE, SPOILED, TRUTH, check_view, slanted, textured


def share(disparity, code, area):
    return (disparity.source == code)[area].mean()


def test_known_holds_for_one_code_and_for_an_image_of_codes():
    codes = np.array(list(PixelOrigin), np.uint8)
    expected = [code in (PixelOrigin.MEASURED, PixelOrigin.PLANE, PixelOrigin.FILLED) for code in PixelOrigin]
    assert known(codes).tolist() == [known(code) for code in PixelOrigin] == expected


@given(
    st.sampled_from([24, 48]), st.sampled_from([0, 5, 255]), st.sampled_from([0, 40]), st.sampled_from([0, 6]),
    st.sampled_from([0.0, 1.5]), st.booleans(), st.integers(0, 99),
)  # fmt: skip
def test_every_unknown_pixel_of_match_has_a_reason(disparities, uniqueness, speckles, radius, depth, guided, seed):
    frame, truth = slanted(height=60, width=120)
    left = frame.left.copy()
    left[20:30, 50:80] = seed % 256
    left[40:50, 20:70] = textured(10, 50, seed).astype(np.uint8)
    coarse = np.where(np.random.default_rng(seed).random(truth.shape) < 0.9, truth, np.nan)
    prior = disparity_of(coarse, confidence=1, stamp=frame.stamp)
    match = Match(
        disparities=disparities, uniqueness=min(uniqueness, 254), max_speckle_size=speckles, max_depth=depth,
        search_radius=radius if guided else 0,
    )  # fmt: skip
    check_view(match(replace(frame, left=left), prior if guided else None), 0, 60)


@pytest.mark.parametrize("stage", [Match(disparities=48), MatchOpenCV(disparities=48)])
def test_what_the_right_image_does_not_show_is_out_of_view(stage):
    hidden = share(stage(SLOPE), PixelOrigin.OUT_OF_VIEW, np.arange(320) < TRUTH - 3)
    assert hidden > 0.5 or isinstance(stage, MatchOpenCV)  # which does not report the checks that failed
    assert share(stage(SLOPE), PixelOrigin.OUT_OF_VIEW, np.arange(320) > TRUTH + 3) == 0
    shifted = replace(stage, min_disparity=7)(SLOPE)
    assert (shifted.source[:, :7] == PixelOrigin.OUT_OF_VIEW).all()


def test_the_reason_of_a_prior_passes_where_nothing_is_searched():
    holed, origin = TRUTH.copy(), np.ones(TRUTH.shape, np.uint8)
    holed[50:70, 100:130], origin[50:70, 100:130] = np.nan, PixelOrigin.SPECKLE
    holed[90:99, 100:130], origin[90:99, 100:130] = np.nan, PixelOrigin.UNKNOWN
    found = Match(search_radius=4)(SLOPE, disparity_of(holed, origin, 1, SLOPE.stamp))
    assert (found.source[50:70, 100:130] == PixelOrigin.SPECKLE).all()
    assert (found.source[90:99, 100:130] == PixelOrigin.OUT_OF_RANGE).all()


def test_matches_that_a_stricter_uniqueness_check_rejects_are_not_unique():
    lax, strict = (Match(disparities=48, uniqueness=limit, max_speckle_size=0)(SLOPE) for limit in (0, 250))
    rejected = known(lax.source) & ~known(strict.source)
    assert rejected.mean() > 0.1
    assert share(strict, PixelOrigin.UNIQUENESS, rejected) == 1
    assert share(lax, PixelOrigin.UNIQUENESS, np.s_[:]) < 0.01


def test_a_patch_that_differs_between_the_images_fails_a_check():
    found = Match(disparities=48, lr_tolerance=1)(SPOILED)
    assert share(found, PixelOrigin.LEFT_RIGHT, np.s_[60:120, 130:220]) > 0.1
    assert share(found, PixelOrigin.SPECKLE, np.s_[60:120, 130:220]) > 0.1
    kept = Match(disparities=48, lr_tolerance=1, max_speckle_size=0)(SPOILED)
    assert share(kept, PixelOrigin.SPECKLE, np.s_[:]) == 0
    assert share(MatchOpenCV(disparities=48)(SPOILED), PixelOrigin.SPECKLE, np.s_[60:120, 130:220]) > 0.1


def test_a_blank_window_is_blank_whatever_the_paths_carry_into_it():
    left = SLOPE.left.copy()
    left[50:80, 150:200] = 255
    found = Match(disparities=48)(replace(SLOPE, left=left))
    assert (found.source[52:78, 152:198] == PixelOrigin.BLANK).all()


def test_the_left_right_check_keeps_the_reasons_of_the_matcher():
    matched = disparity_of([[np.nan, *9 * [5]]], np.array([[PixelOrigin.SPECKLE, *9 * [PixelOrigin.MEASURED]]]))
    checked = LeftRightCheck()(matched, disparity_of(np.full((1, 10), 9)))
    assert checked.source[0].tolist() == [PixelOrigin.SPECKLE] + 4 * [1] + 5 * [PixelOrigin.LEFT_RIGHT]
