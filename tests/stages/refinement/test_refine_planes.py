"""Planes of superpixels and regions in Refine: accepted by agreement, bounded in slope and range."""

import numpy as np
import pytest

from stages.data import Disparity, PixelOrigin
from stages.refinement import refine as module
from stages.refinement.refine import Refine
from tests.stages.refinement.flat_scene import SHAPE, WIDTH, flat_scene


def test_a_plane_steeper_than_allowed_fills_nothing(monkeypatch):
    frame, pixels, source, confidence = flat_scene()
    pixels += 0.4 * np.arange(WIDTH, dtype=np.float32)
    hole = np.s_[50:55, 70:75]
    pixels[hole], source[hole] = np.nan, 0
    matches = Disparity(5, pixels, source, confidence)
    refine = Refine(superpixels=60, min_superpixel_size=1, fill=False)
    filled = refine(frame, matches)
    assert (filled.source[hole] == PixelOrigin.PLANE).all()
    assert np.abs(filled.pixels[hole] - (8 + 0.4 * np.arange(70, 75))).max() < 0.1
    monkeypatch.setattr(module, "MAX_GRADIENT", 0.35)
    assert np.isnan(refine(frame, matches).pixels[hole]).all()


@pytest.mark.parametrize("side", [-1, 1])
def test_a_plane_is_not_followed_beyond_the_range_of_all_matches(side):
    frame, pixels, source, confidence = flat_scene(100.0)
    pixels += side * 0.4 * np.arange(WIDTH, dtype=np.float32)
    pixels[:, 150:], source[:, 150:] = np.nan, 0
    matches = Disparity(5, pixels, source, confidence)
    # One superpixel: its plane would go on to the image's right border.
    filled = Refine(superpixels=1, min_superpixel_size=1, fill=False, median_size=0)(frame, matches)
    assert np.isfinite(filled.pixels[:, :149]).all()
    assert np.isnan(filled.pixels[:, 151:]).all()


def test_planes_of_regions_fill_superpixels_without_matches():
    frame, pixels, source, confidence = flat_scene()
    pixels += 0.03 * np.arange(WIDTH, dtype=np.float32)
    hole = np.s_[45:75, 60:100]  # larger than a superpixel, smaller than a surface
    truth = pixels[hole].copy()
    pixels[hole], source[hole] = np.nan, 0
    matches = Disparity(5, pixels, source, confidence)
    bare = Refine(superpixels=200, min_superpixel_size=1, fill=False, surface_size=0)(frame, matches)
    assert np.isnan(bare.pixels[hole]).mean() > 0.5
    wide = Refine(superpixels=200, min_superpixel_size=1, fill=False, surface_size=50)(frame, matches)
    assert (wide.source[hole] == PixelOrigin.PLANE).all()
    assert np.abs(wide.pixels[hole] - truth).max() < 0.05


# A superpixel with a hole then gets no plane; a region gets one if half of it is matched.
SURFACES_ONLY = {"superpixels": 1, "min_superpixel_size": 1, "surface_size": 1}


@pytest.mark.parametrize(("surface_size", "min_valid"), [(0, 0.6), (1, 1.0)])
def test_a_plane_counts_matches_by_their_confidence(surface_size, min_valid, monkeypatch):
    monkeypatch.setattr(module, "MIN_VALID_SHARE", min_valid)
    parameters = SURFACES_ONLY | {"surface_size": surface_size}
    frame, pixels, source, confidence = flat_scene()
    doubted = np.random.default_rng(4).random(SHAPE) < 0.5
    pixels[doubted], confidence[doubted] = 8.4, 0.5
    hole = np.s_[50:55, 70:75]
    pixels[hole], source[hole], confidence[hole] = np.nan, 0, 0
    refine = Refine(median_size=0, bilateral_radius=0, edge_radius=0, support=False, **parameters)
    filled = refine(frame, Disparity(5, pixels, source, confidence))
    half = doubted[np.isfinite(pixels)].mean()
    mean = (8 * (1 - half) + 8.4 * half * 0.5) / (1 - half + half * 0.5)
    assert filled.pixels[hole] == pytest.approx(mean, abs=0.01)


def test_a_region_pulls_half_as_far_and_agreement_adds_confidence(monkeypatch):
    monkeypatch.setattr(module, "MIN_VALID_SHARE", 1.0)
    frame, pixels, source, confidence = flat_scene()
    pixels[60, 80], pixels[60, 90] = 8.4, 8.7
    pixels[30, 30], source[30, 30] = np.nan, 0
    matches = Disparity(5, pixels, source, confidence)
    steps = {"median_size": 0, "bilateral_radius": 0, "edge_radius": 0, "support": False}
    drawn = Refine(plane_weight=1, **steps, **SURFACES_ONLY)(frame, matches)
    assert drawn.pixels[60, 80] == pytest.approx(8, abs=0.01)
    assert drawn.pixels[60, 90] == np.float32(8.7)
    assert drawn.confidence[60, 70] > drawn.confidence[60, 90] > 0.9
    assert (drawn.source[60, 70], drawn.source[60, 90]) == (PixelOrigin.MEASURED, PixelOrigin.MEASURED)


def test_filled_pixels_are_no_evidence_for_planes_of_regions():
    frame, pixels, source, confidence = flat_scene()
    holes = np.random.default_rng(6).random(SHAPE) < 0.3
    holes[:, 60:] = True  # the rest is three eighths of the image, and matched by seven tenths
    pixels[holes], source[holes] = np.nan, 0
    refine = Refine(
        superpixels=48, min_superpixel_size=1, surface_size=48, fill=False, bilateral_radius=0, edge_radius=0
    )
    filled = refine(frame, Disparity(5, pixels, source, confidence))
    assert np.isfinite(filled.pixels[:, :59]).mean() > 0.95
    assert np.isnan(filled.pixels[:, 62:]).all()
