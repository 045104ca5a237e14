"""Planes of superpixels and regions in Refine: accepted by agreement, bounded in slope and range."""

import numpy as np
import pytest

from stages.data import PixelOrigin
from stages.refinement import refine as module
from stages.refinement.refine import Refine
from tests.stages.refinement.flat_scene import GRAY, SHAPE, WIDTH, flat, matched


def test_a_plane_steeper_than_allowed_fills_nothing(monkeypatch):
    pixels, hole = flat() + np.float32(0.4) * np.arange(WIDTH), np.s_[50:55, 70:75]
    pixels[hole] = np.nan
    refine, matches = Refine(superpixels=60, min_superpixel_size=1, fill=False), matched(pixels)
    filled = refine(GRAY, matches)
    assert (filled.source[hole] == PixelOrigin.PLANE).all()
    assert np.abs(filled.pixels[hole] - (8 + 0.4 * np.arange(70, 75))).max() < 0.1
    monkeypatch.setattr(module, "MAX_GRADIENT", 0.35)
    assert np.isnan(refine(GRAY, matches).pixels[hole]).all()


@pytest.mark.parametrize("side", [-1, 1])
def test_a_plane_is_not_followed_beyond_the_range_of_all_matches(side):
    pixels = flat(100.0) + side * 0.4 * np.arange(WIDTH)
    pixels[:, 150:] = np.nan
    # One superpixel: its plane would go on to the image's right border.
    filled = Refine(superpixels=1, min_superpixel_size=1, fill=False, median_size=0)(GRAY, matched(pixels))
    assert np.isfinite(filled.pixels[:, :149]).all()
    assert np.isnan(filled.pixels[:, 151:]).all()


def test_planes_of_regions_fill_superpixels_without_matches():
    truth, hole = flat() + 0.03 * np.arange(WIDTH), np.s_[45:75, 60:100]  # larger than a superpixel
    pixels = truth.copy()
    pixels[hole] = np.nan
    bare, wide = (
        Refine(superpixels=200, min_superpixel_size=1, fill=False, surface_size=size)(GRAY, matched(pixels))
        for size in (0, 50)
    )
    assert np.isnan(bare.pixels[hole]).mean() > 0.5
    assert (wide.source[hole] == PixelOrigin.PLANE).all()
    assert np.abs(wide.pixels - truth)[hole].max() < 0.05


def test_small_superpixels_have_planes_of_all_their_pixels():
    pixels = flat() + 0.03 * np.arange(WIDTH)
    holes = np.s_[2::7, 3::7]
    truth, pixels[holes] = pixels[holes].copy(), np.nan
    count = pixels.size // 9
    filled = Refine(superpixels=count, min_superpixel_size=1, surface_size=0, fill=False)(GRAY, matched(pixels))
    known = np.isfinite(filled.pixels[holes])
    assert known.mean() > 0.5
    assert np.abs(filled.pixels[holes] - truth)[known].max() < 0.05


# A superpixel with a hole then gets no plane; a region gets one if half of it is matched.
SURFACES_ONLY = {"superpixels": 1, "min_superpixel_size": 1, "surface_size": 1}
PLANES_ALONE = {"median_size": 0, "bilateral_radius": 0, "edge_radius": 0, "support": False}


@pytest.mark.parametrize(("surface_size", "min_valid"), [(0, 0.6), (1, 1.0)])
def test_a_plane_counts_matches_by_their_confidence(surface_size, min_valid, monkeypatch):
    monkeypatch.setattr(module, "MIN_VALID_SHARE", min_valid)
    parameters = SURFACES_ONLY | {"surface_size": surface_size}
    doubted, hole = np.random.default_rng(4).random(SHAPE) < 0.5, np.s_[50:55, 70:75]
    pixels = np.where(doubted, 8.4, flat())
    pixels[hole] = np.nan
    matches = matched(pixels, np.where(doubted, 0.5, 1) * np.isfinite(pixels))
    filled = Refine(**PLANES_ALONE, **parameters)(GRAY, matches)
    half = doubted[np.isfinite(pixels)].mean()
    mean = (8 * (1 - half) + 8.4 * half * 0.5) / (1 - half + half * 0.5)
    assert filled.pixels[hole] == pytest.approx(mean, abs=0.01)


def test_a_region_moves_no_match_and_agreement_adds_confidence(monkeypatch):
    monkeypatch.setattr(module, "MIN_VALID_SHARE", 1.0)
    pixels = flat()
    pixels[60, 80], pixels[60, 90], pixels[30, 30] = 8.4, 8.7, np.nan
    drawn = Refine(plane_weight=1, **PLANES_ALONE, **SURFACES_ONLY)(GRAY, matched(pixels))
    assert drawn.pixels[30, 30] == pytest.approx(8, abs=0.01)
    assert (drawn.pixels[60, 80], drawn.pixels[60, 90]) == (np.float32(8.4), np.float32(8.7))
    assert drawn.confidence[60, 70] > drawn.confidence[60, 90] > 0.9
    assert (drawn.source[60, 70], drawn.source[60, 90]) == (PixelOrigin.MEASURED, PixelOrigin.MEASURED)


def test_filled_pixels_are_no_evidence_for_planes_of_regions():
    pixels = flat()
    pixels[np.random.default_rng(6).random(SHAPE) < 0.3] = np.nan
    pixels[:, 60:] = np.nan  # the rest is three eighths of the image, and matched by seven tenths
    parameters = {"superpixels": 48, "min_superpixel_size": 1, "surface_size": 48}
    filled = Refine(fill=False, bilateral_radius=0, edge_radius=0, **parameters)(GRAY, matched(pixels))
    assert np.isfinite(filled.pixels[:, :59]).mean() > 0.95
    assert np.isnan(filled.pixels[:, 62:]).all()
