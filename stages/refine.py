"""Superpixel refinement of a disparity image (sections 3.2 and 3.3 of the paper): SLIC, planes, filling, bilateral.

The paper's idea is kept, its trust in planes is not: a plane counts only where the superpixel's own matches agree on
it, it pulls the matches near to it and leaves the others alone, and what no evidence explains stays unknown.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stages.data import Array, Disparity, Source, StereoFrame
from stages.intensity import eight_bit, gray
from stages.kernels.background import fill_background
from stages.kernels.bilateral import joint_bilateral
from stages.kernels.planes import Planes, fit_planes, render_planes
from stages.kernels.slic import superpixels
from stages.kernels.smoother import smooth
from stages.stage import Stage, parameter

F32 = np.float32
PLANE_TRUST = 0.5  # confidence of a pixel that only its superpixel's plane knows, at an inlier share of 1
FILL_TRUST = 0.25  # the same of a pixel filled from beside


@dataclass(frozen=True)
class Refine(Stage):
    """A denser and smoother disparity image, with the superpixels it was made with.

    Only MEASURED pixels are matches; all others count as holes. What moves by at most `inlier_distance` stays MEASURED
    and keeps its confidence. A match that moves farther has been replaced by what lies about it: it becomes PLANE, as a
    hole that its superpixel's plane fills, and its confidence at most 0.5; a filled pixel has at most 0.25. With `fill`
    wls a hole is filled from all around by the confidence-weighted smoother; with background from the farther of its
    ends in the row.
    """

    trusted: float = parameter(0.5, "confidence below which a match is treated as unknown", low=0, high=1)
    median: int = parameter(5, "side of the median filter over matches, 0 = none", unit="px", choices=(0, 3, 5))
    near: float = parameter(
        1.0, "distance up to which a match moves to its median or plane; a farther one stays", unit="px", low=0
    )
    superpixels: int = parameter(4000, "number of superpixels aimed at", low=1)
    compactness: float = parameter(10.0, "SLIC's weight of position against colour, CIELAB units", low=0.1)
    inlier_distance: float = parameter(0.5, "deviation from a plane that makes an outlier", unit="px", low=0.01)
    hypotheses: int = parameter(64, "planes tried per superpixel", low=1)
    inlier_share: float = parameter(0.7, "least share of inliers for a plane to be accepted", low=0, high=1)
    valid_share: float = parameter(0.6, "least share of matched pixels for a plane to be accepted", low=0, high=1)
    slope: float = parameter(0.5, "steepest disparity gradient of an accepted plane", unit="px/px", low=0)
    plane_weight: float = parameter(0.7, "weight of the plane against a match near to it", low=0, high=1)
    plane_fill: bool = parameter(True, "whether an accepted plane also fills the holes of its superpixel")
    fill: str = parameter("background", "how the other holes are filled", choices=("background", "wls", "none"))
    fill_reach: float = parameter(
        32.0, "background: how much wider than the step between its ends a filled hole may be", unit="px", low=0
    )
    fill_support: float = parameter(0.001, "wls: least smoothed confidence that fills a pixel", low=0)
    wls_lambda: float = parameter(8000.0, "wls: strength of the smoothing", low=0)
    wls_sigma: float = parameter(1.0, "wls: gray levels over which the coupling falls to 1/e", low=0.01)
    bilateral_radius: int = parameter(6, "radius of the bilateral filter, 0 = none", unit="px", low=0, high=32)
    bilateral_space: float = parameter(4.0, "its standard deviation in the image", unit="px", low=0.1)
    bilateral_gray: float = parameter(10.0, "its scale in gray levels", low=0.1)
    bilateral_disparity: float = parameter(1.0, "its scale in disparity", unit="px", low=0.01)

    def __call__(self, frame: StereoFrame, disparity: Disparity) -> Disparity:
        if disparity.pixels.shape != frame.left.shape[:2]:
            raise ValueError(f"Refine: disparity is {disparity.pixels.shape}, the image is {frame.left.shape[:2]}")
        image = eight_bit(frame.left)[0]
        guide = gray(image)
        measured = self._trusted_matches(disparity)
        matches = self._median(measured)
        labels, count = superpixels(image, self.superpixels, self.compactness)
        planes = fit_planes(matches, labels, count, self.inlier_distance, self.hypotheses, disparity.stamp)
        pixels = self._pulled_to_planes(matches, self._accepted(planes), labels)
        plane_confidence = F32(PLANE_TRUST) * planes.inlier_share[labels]
        confidence = np.where(np.isfinite(matches), disparity.confidence, plane_confidence)
        filled, support = self._filled(pixels, confidence, guide)
        refined = self._bilateral(filled, guide)
        source = _sources(np.abs(refined - measured) <= self.inlier_distance, pixels, refined)
        replaced = (source == Source.PLANE) & np.isfinite(measured)
        confidence[replaced] = np.minimum(confidence, plane_confidence)[replaced]
        confidence[source == Source.FILLED] = F32(FILL_TRUST) * support[source == Source.FILLED]
        confidence[source == Source.UNKNOWN] = 0
        return Disparity(frame.stamp, refined, source, confidence, labels, frame.camera)

    def _trusted_matches(self, disparity: Disparity) -> Array:
        """The matches that are trusted, (H, W) float32, NaN elsewhere."""
        trusted = (disparity.source == Source.MEASURED) & (disparity.confidence >= self.trusted)
        return np.where(trusted & np.isfinite(disparity.pixels), disparity.pixels, F32(np.nan))

    def _median(self, matches: Array) -> Array:
        """The matches, each moved to the median of those around it where that is near; (H, W) float32.

        The median filter knows no NaN, so a hole counts as farther than all: holes are of the background, as a rule.
        A match with fewer neighbours than holes about it has no median and stays.
        """
        if not self.median:
            return matches
        median = cv2.medianBlur(np.where(np.isnan(matches), F32(-np.inf), matches), self.median)
        return np.where(np.abs(median - matches) <= self.near, median, matches)

    def _accepted(self, planes: Planes) -> Array:
        """The coefficients (n, 3) of the planes that the evidence supports; NaN for the others."""
        slope = np.hypot(planes.coefficients[:, 0], planes.coefficients[:, 1])
        supported = (planes.inlier_share >= self.inlier_share) & (planes.valid_share >= self.valid_share)
        return np.where((supported & (slope <= self.slope))[:, None], planes.coefficients, np.nan)

    def _pulled_to_planes(self, matches: Array, coefficients: Array, labels: Array) -> Array:
        """Matches near their superpixel's plane drawn towards it, its holes filled from it; (H, W) float32."""
        plane = render_planes(coefficients, labels)
        near = np.abs(plane - matches) <= self.near
        pixels = np.where(near, matches + F32(self.plane_weight) * (plane - matches), matches)
        if self.plane_fill and np.isfinite(matches).any():
            # A plane that leaves the range of all matches is extrapolated too far.
            sane = (plane >= np.nanmin(matches)) & (plane <= np.nanmax(matches))
            pixels = np.where(np.isnan(matches) & sane, plane, pixels)
        return pixels

    def _filled(self, pixels: Array, confidence: Array, guide: Array) -> tuple[Array, Array]:
        """The remaining holes filled as far as evidence reaches, and how much evidence: two (H, W) float32."""
        known = np.isfinite(pixels)
        if self.fill == "wls":
            weights = np.where(known, confidence, F32(0))
            smoothed, support = smooth(pixels, weights, guide, self.wls_lambda, self.wls_sigma)
            smoothed[support < self.fill_support] = np.nan
            return np.where(known, pixels, smoothed), np.minimum(support, 1)
        filled = fill_background(pixels, self.fill_reach) if self.fill == "background" else pixels
        return filled, np.ones_like(pixels)

    def _bilateral(self, pixels: Array, guide: Array) -> Array:
        if self.bilateral_radius == 0:
            return pixels
        return joint_bilateral(
            pixels, guide, self.bilateral_radius, self.bilateral_space, self.bilateral_gray, self.bilateral_disparity
        )


def _sources(as_measured: Array, with_planes: Array, refined: Array) -> Array:
    """Where each disparity comes from, codes of `Source`, (H, W) uint8."""
    source = np.full(refined.shape, Source.UNKNOWN, np.uint8)
    source[np.isfinite(refined)] = Source.FILLED
    source[np.isfinite(with_planes)] = Source.PLANE
    source[as_measured] = Source.MEASURED
    return source
