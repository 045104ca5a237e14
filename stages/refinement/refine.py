"""Superpixel refinement of a disparity image (sections 3.2 and 3.3 of the paper): SLIC, planes, filling, bilateral;
and depth edges moved to where the image has them.

The paper's idea is kept, its trust in planes is not: a plane counts only where the segment's own matches agree on it,
it pulls the matches near to it and leaves the others alone, and what no evidence explains stays unknown. Planes come
in two sizes, of superpixels and of surfaces, groups of them, because walls and sand show too little for the small ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stages.compiled.parallel import by_bands, shared_by
from stages.data import Array, Disparity, StereoFrame
from stages.matching.intensity import eight_bit, gray
from stages.matching.kernels.blank_windows import contrast
from stages.refinement.kernels.bilateral import joint_bilateral
from stages.refinement.kernels.correlation import correlation
from stages.refinement.kernels.depth_edges import sharpen_edges
from stages.refinement.kernels.holes import KEPT, OCCLUSION, fill_holes
from stages.refinement.kernels.pixel_origin import Trust, label_origin
from stages.refinement.kernels.plane_apply import near_median, pull_to_planes, trusted_matches
from stages.refinement.kernels.plane_fit import Planes, fit_planes
from stages.refinement.kernels.region_merging import surfaces
from stages.refinement.kernels.slic import superpixels
from stages.refinement.kernels.subpixel import fit_brightness
from stages.refinement.kernels.valid_extent import Extent, extent
from stages.stage import Stage, check_joined, check_same_time, parameter

F32 = np.float32
SATURATION_LEVEL = 250  # 8-bit level from which an even patch is saturated, a sky for example
MAX_CORRECTION = 1.0  # px; a match farther from its median or plane stays as it is
INLIER_DISTANCE = 0.5  # px, from a plane
MIN_INLIER_SHARE, MIN_VALID_SHARE = 0.8, 0.6  # of a superpixel with an accepted plane; a surface needs half the matches
MAX_GRADIENT = 0.5  # px/px, of an accepted plane
EVEN = 6  # gray levels within a census window that a camera's noise and compression make of one
COMPACTNESS = 10.0  # SLIC's weight of position against colour, CIELAB units
BILATERAL_GRAY, BILATERAL_DISPARITY = 10.0, 1.0  # scales of the bilateral filter, gray levels and px
JUMP = 2.0  # px, between neighbours, beyond which there is an edge of depth
JUMP_GRAY = 10.0  # gray levels over which a neighbour's weight falls to 1/e there
# Measured with the pipeline `rover` by tests/study.py: the mean of eight Middlebury scenes and of simulated frames.
TRUST = Trust(
    agreed=(0.88, 0.98, 0.998), alone=(0.62, 0.86, 0.97), replaced=0.81, plane=0.79, mismatch=0.72, occlusion=0.66
)


@dataclass(frozen=True)
class Refine(Stage):
    """A denser and smoother disparity image, with the superpixels it was made with.

    Only MEASURED pixels are matches; all others count as holes. First brightness tells their fraction of a pixel, which
    matching draws to 0. What then moves by at most INLIER_DISTANCE stays MEASURED, where the images bear it out;
    where they do not, as in a noisy sky, it becomes FILLED.
    A match that moves farther has been replaced by what lies about it: it becomes PLANE, as a hole that a plane fills.
    Without planes, `plane_weight` 0 and no `plane_fill`, no superpixels are made.
    With `fill` the other holes are filled from what lies about them and looks like them, from the farther surface where
    there are two. The confidence is the share of pixels of that origin that were right within 1 px.
    """

    min_confidence: float = parameter(0.5, "confidence below which a match is treated as unknown", low=0, high=1)
    subpixel_radius: int = parameter(
        2, "radius of the windows by which brightness tells the fraction of a pixel of a match, 0 = not asked",
        unit="px", low=0, high=16,
    )  # fmt: skip
    median_size: int = parameter(5, "side of the median filter over matches, 0 = none", unit="px", choices=(0, 3, 5))
    superpixels: int = parameter(4000, "number of superpixels aimed at", low=1)
    min_superpixel_size: int = parameter(
        300, "pixels that a superpixel shall have on average; a small image gets fewer", unit="px", low=1
    )
    surface_size: int = parameter(16, "superpixels in a surface, the larger support of planes; 0 = none", low=0)
    hypotheses: int = parameter(16, "planes tried per segment", low=1)
    plane_weight: float = parameter(0.5, "weight of the plane against a match near to it", low=0, high=1)
    plane_fill: bool = parameter(True, "whether an accepted plane also fills the holes of its segment")
    fill: bool = parameter(True, "whether the remaining holes are filled from the background")
    max_fill_distance: float = parameter(
        64.0, "distance from which a hole is still filled; what is hidden here, from any", unit="px", low=0
    )
    max_extrapolation: int = parameter(
        16, "how far beyond the last match, at the image's border or towards the sky", unit="px", low=0
    )
    bilateral_radius: int = parameter(
        3, "radius of the bilateral filter and its scale in the image, 0 = none", unit="px", low=0, high=32
    )
    edge_radius: int = parameter(
        3, "radius of the weighted median that puts depth edges where the image has them, 0 = none", unit="px", low=0,
        high=16,
    )  # fmt: skip
    min_correlation: float = parameter(
        0.5, "of the images about a match, below which it counts as a guess, 0 = not asked", low=0, high=1
    )
    threads: int = parameter(1, "most cores for one frame (two are used); never changes the result", low=1)

    def __call__(self, frame: StereoFrame, disparity: Disparity) -> Disparity:
        check_joined(self, frame, disparity)
        check_same_time(self, frame=frame.stamp, disparity=disparity.stamp)
        image, other = eight_bit(frame.left, frame.right)
        guide, right = gray(image), gray(other)
        matches, weights, reasons = trusted_matches(
            disparity.pixels, disparity.source, disparity.confidence, self.min_confidence,
            _burnt_out(frame.left, guide, SATURATION_LEVEL, self.threads), self.threads,
        )  # fmt: skip
        if self.subpixel_radius:
            matches = fit_brightness(guide, right, matches, self.subpixel_radius, self.threads)
        pixels = near_median(matches, self.median_size, MAX_CORRECTION, self.threads) if self.median_size else matches
        within, labels, agreed = extent(pixels, self.threads), None, np.zeros(pixels.shape, bool)
        if self.plane_weight or self.plane_fill:
            labels, count = superpixels(image, self._count(pixels.size), COMPACTNESS, threads=self.threads)
            pixels, agreed = self._with_planes(pixels, weights, within, image, labels, count, disparity.stamp)
        filled, kinds = self._filled(pixels, within, image)
        guessed = kinds != KEPT
        refined = self._sharpened(self._bilateral(filled, guide), guessed, guide)
        source, confidence = label_origin(
            matches, disparity.confidence, agreed, kinds, refined,
            self._borne_out(refined, guessed, guide, right), reasons, INLIER_DISTANCE, TRUST, self.threads,
        )  # fmt: skip
        return Disparity(frame.stamp, refined, source, confidence, labels, frame.camera)

    def _count(self, pixels: int) -> int:
        return max(1, min(self.superpixels, pixels // self.min_superpixel_size))

    def _with_planes(
        self, pixels: Array, weights: Array, within: Extent, image: Array, labels: Array, count: int, seed: int
    ) -> tuple[Array, Array]:
        """Matches near their planes drawn towards them, holes filled from them, (H, W) float32; where, (H, W) bool."""
        margin = self.max_extrapolation if self.plane_fill else -1
        planes = fit_planes(pixels, labels, count, weights, self.hypotheses, INLIER_DISTANCE, seed, self.threads)
        accepted = self._accepted(planes, MIN_VALID_SHARE)
        pixels, agreed = pull_to_planes(
            pixels, accepted, labels, within, MAX_CORRECTION, self.plane_weight, margin, self.threads
        )
        if not self.surface_size:
            return pixels, agreed
        group, groups = surfaces(
            image, labels, count, max(1, count // self.surface_size), COMPACTNESS, threads=self.threads
        )
        # Every other pixel of every other row is plenty for a surface.
        few = np.s_[::2, ::2]
        sparse, regions = (layer[few].copy() for layer in (pixels, labels))
        sparse[weights[few] == 0] = np.nan  # what the first planes filled is no evidence for the second
        planes = fit_planes(
            sparse, group.take(regions), groups, np.ascontiguousarray(weights[few]), self.hypotheses,
            INLIER_DISTANCE, seed + 1, self.threads,
        )  # fmt: skip
        accepted = (self._accepted(planes, MIN_VALID_SHARE / 2, 2) * [0.5, 0.5, 1])[group]
        pixels, again = pull_to_planes(
            pixels, accepted, labels, within, MAX_CORRECTION / 2, self.plane_weight, margin, self.threads
        )
        return pixels, agreed | again

    def _accepted(self, planes: Planes, valid_share: float, spacing: int = 1) -> Array:
        """The coefficients (n, 3) of the planes that the evidence supports, of pixels `spacing` px apart; NaN for the
        others."""
        slope = np.hypot(planes.coefficients[:, 0], planes.coefficients[:, 1])
        supported = (planes.inlier_share >= MIN_INLIER_SHARE) & (planes.valid_share >= valid_share)
        return np.where((supported & (slope <= MAX_GRADIENT * spacing))[:, None], planes.coefficients, np.nan)

    def _filled(self, pixels: Array, within: Extent, image: Array) -> tuple[Array, Array]:
        """The remaining holes filled as far as evidence reaches, (H, W) float32, and their kinds of `holes`."""
        if self.fill:
            return fill_holes(pixels, image, within, self.max_fill_distance, self.max_extrapolation, self.threads)
        return pixels, np.where(np.isnan(pixels), np.uint8(OCCLUSION), np.uint8(KEPT))

    def _bilateral(self, pixels: Array, guide: Array) -> Array:
        if self.bilateral_radius == 0:
            return pixels
        return joint_bilateral(pixels, guide, self.bilateral_radius, BILATERAL_GRAY, BILATERAL_DISPARITY, self.threads)

    def _borne_out(self, pixels: Array, guessed: Array, guide: Array, right: Array) -> Array:
        """Where the images vary alike, so shifted, (H, W) bool."""
        if self.min_correlation == 0:
            return np.ones(pixels.shape, bool)
        return correlation(pixels, guessed, guide, right, self.threads) >= F32(self.min_correlation)

    def _sharpened(self, pixels: Array, guessed: Array, guide: Array) -> Array:
        if self.edge_radius == 0:
            return pixels
        return sharpen_edges(pixels, guessed, guide, self.edge_radius, JUMP, JUMP_GRAY, self.threads)


def _burnt_out(image: Array, guide: Array, level: int, threads: int) -> Array:
    """Where the image is even and a colour of it burnt out, (H, W) bool: what is matched there is noise."""
    burnt = np.zeros(guide.shape, bool)

    def mark(first: int, end: int) -> None:
        rows = image[first:end]
        bright = rows >= level if image.ndim == 2 else cv2.inRange(rows, (0,) * 3, (level - 1,) * 3) == 0
        if bright.any():
            burnt[first:end] = bright & (contrast(guide, first, end) <= EVEN)

    if image.dtype == np.uint8:  # of more bits nothing tells where the sensor ends
        by_bands(shared_by(threads), len(image), mark)
    return burnt
