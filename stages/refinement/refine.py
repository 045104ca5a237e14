"""Superpixel refinement of a disparity image (sections 3.2 and 3.3 of the paper): SLIC, planes, filling, bilateral.

The paper's idea is kept, but not its trust in planes. A plane counts only where the matches of its segment agree on it.
It pulls the matches near it and leaves the others alone. What no evidence explains stays unknown. Planes come in two
sizes, of superpixels and of regions of them, because walls and sand show too little for the small ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from stages.data import Array, Disparity, StereoFrame
from stages.data.rows import disparity_rows, frame_rows, rows_without_sigma, with_rows
from stages.matching.image_noise import frame_noise
from stages.matching.intensity import alike, eight_bit, gray_pair
from stages.matching.kernels.texture import FLOOR, SMOOTH_FLOOR, contrast, slopes
from stages.refinement.kernels.bilateral import joint_bilateral
from stages.refinement.kernels.bridges import bridge_holes
from stages.refinement.kernels.depth_edges import sharpen_edges
from stages.refinement.kernels.holes import KEPT, OCCLUSION, fill_holes
from stages.refinement.kernels.label_origin import Trust, label_origin
from stages.refinement.kernels.plane_apply import near_median, pull_to_planes, trusted_matches
from stages.refinement.kernels.plane_fit import fit_planes
from stages.refinement.kernels.region_merging import merge_regions
from stages.refinement.kernels.slic import superpixels
from stages.refinement.kernels.subpixel import fit_brightness
from stages.refinement.kernels.support import supported
from stages.refinement.kernels.valid_extent import Extent, extent
from stages.stage import Stage, check_confidence, check_joined, check_same_time, parameter

F32 = np.float32
SATURATION_LEVEL = 250  # 8-bit level from which an even patch is saturated, a sky for example
MAX_CORRECTION = 1.0  # px; a match farther from its median or plane stays as it is
MIN_INLIER_SHARE, MIN_VALID_SHARE = 0.8, 0.6  # of a superpixel with an accepted plane; a surface needs half the matches
MAX_GRADIENT = 0.5  # px/px, of an accepted plane
MIN_SPARSE_SIZE = 64  # px; planes of segments of this mean size are fitted to a quarter of the pixels
BLACK_LEVEL, BLACK_SIGMAS = 4, 3  # gray levels, and noise at level 0, up to which a shadow is black
BLACK_WINDOW, BLACK_MARGIN = 5, 3  # px: of the median that is black, and around it
MAX_EVEN_CONTRAST = 6  # gray levels in a census window: noise and compression of a uniform patch
MAX_FILL_DISTANCE = 64.0  # px to a disparity that fills a hole; of an occlusion any distance
MAX_EXTRAPOLATION = 16  # px that holes are filled beyond the last match, at the border or towards the sky
# Fitted to eight Middlebury scenes and simulated frames, which count alike; tests/study.py prints the true shares.
TRUST = Trust(
    agreed=(0.955, 0.993, 0.998),
    alone=(0.73, 0.91, 0.99),
    backed=0.82,
    replaced=0.81,
    plane=0.79,
    mismatch=0.72,
    occlusion=0.66,
)


@dataclass(frozen=True)
class Refine(Stage):
    """A denser and smoother disparity image, with its superpixels.

    A match that moves by at most 0.5 px and two sigmas stays MEASURED if the images correlate over its support and its
    sigma is small, else it becomes FILLED. A match that moves farther and a hole that a plane fills are MEASURED if
    their support passes the same tests, else PLANE. Another filled hole must also be seen by both cameras, else it is
    FILLED. The confidence is the calibrated fraction of such pixels that are right within 1 px. A pixel that stays
    unknown keeps its reason. A dropped match has SKY (saturated patch), UNIQUENESS (low confidence) or OUT_OF_VIEW.
    Rows that `Match.max_prior_step` copied are refined already and stay as they are. See docs/refinement.md.

    References
    ----------
    Lu et al., arXiv 2509.05645, sections 3.2 and 3.3; Hirschmueller, 2008, section 2.5.3 (filling).

    Examples
    --------
    >>> import numpy as np
    >>> from stages import Disparity, Refine, StereoCamera, StereoFrame
    >>> camera = StereoCamera(fx=50.0, fy=50.0, cx=20.0, cy=15.0, baseline=0.1, width=40, height=30)
    >>> image = np.random.default_rng(0).integers(60, 190, (30, 48)).astype(np.uint8)
    >>> frame = StereoFrame(0, image[:, :40].copy(), image[:, 5:45].copy(), camera)
    >>> pixels = np.full((30, 40), 5, np.float32)
    >>> pixels[10:14, 20:24] = np.nan
    >>> matched = Disparity(0, pixels, np.isfinite(pixels).astype(np.uint8), np.ones((30, 40), np.float32))
    >>> bool(np.isfinite(Refine()(frame, matched).pixels[10:14, 20:24]).all())
    True
    """

    min_confidence: float = parameter(0.5, "confidence below which a match counts as unknown", low=0, high=1)
    subpixel_radius: int = parameter(
        2, "radius of the windows that fit subpixel fractions to brightness; 0: no fit",
        unit="px", low=0, high=16,
    )  # fmt: skip
    median_size: int = parameter(5, "side of the median filter over matches; 0: none", unit="px", choices=(0, 3, 5))
    superpixels: int = parameter(4000, "number of superpixels that SLIC aims at", low=1)
    min_superpixel_size: int = parameter(
        300, "smallest mean size of a superpixel; a small image gets fewer superpixels", unit="px", low=1
    )
    surface_size: int = parameter(16, "superpixels in a surface, to which planes are fitted too; 0: none", low=0)
    hypotheses: int = parameter(16, "planes tried in each segment", low=1, high=10_000)
    plane_weight: float = parameter(0.5, "weight of the plane against a match near it", low=0, high=1)
    plane_fill: bool = parameter(True, "whether an accepted plane also fills the holes of its segment")
    fill: bool = parameter(True, "whether the remaining holes are filled from the background")
    bridge: bool = parameter(
        True, "whether a straight line between its ends fills a hole that both cameras see, if the images contradict "
        "the other filling; for ground, not for rooms",
    )  # fmt: skip
    bilateral_radius: int = parameter(
        3, "radius and spatial sigma of the bilateral filter; 0: none", unit="px", low=0, high=32
    )
    edge_radius: int = parameter(
        3, "radius of the windows that move depth edges to where the images have them; 0: none", unit="px", low=0,
        high=16,
    )  # fmt: skip
    support: bool = parameter(True, "whether matches of weak texture move towards planes of growing windows")
    min_support_shift: float = parameter(
        0.0, "for a guide: smallest shift by support that is applied; without small ones the errors of neighbours stay "
        "independent; sigma is that of the support; needs `support`", unit="px", low=0,
    )  # fmt: skip
    min_correlation: float = parameter(
        0.4,
        "correlation of the images over a pixel's support below which it becomes FILLED; 0: no test; needs `support`",
        low=0,
        high=1,
    )
    max_sigma: float = parameter(
        0.6, "standard deviation above which a pixel becomes FILLED; needs `support`", unit="px", low=0
    )
    threads: int = parameter(
        1, "largest number of cores for one frame (two are used); does not change the result", low=1
    )

    def __call__(self, frame: StereoFrame, disparity: Disparity) -> Disparity:
        """Refine `disparity`, the left disparity of the rectified `frame`."""
        check_joined(self, frame, disparity)
        check_same_time(self, frame=frame.stamp, disparity=disparity.stamp)
        check_confidence(self, disparity)
        rows = rows_without_sigma(disparity)
        if not rows:
            return self._refined(frame, disparity)
        part = disparity_rows(disparity, rows.start, rows.stop)
        refined = self._refined(frame.once(frame_rows, rows.start, rows.stop), part)
        return with_rows(replace(disparity, costs=None, camera=frame.camera), rows.start, refined)

    def _refined(self, frame: StereoFrame, disparity: Disparity) -> Disparity:
        image, other = eight_bit(frame.left, frame.right)
        guide, right = frame.once(gray_pair)
        saturated = _saturated(frame.left, guide, SATURATION_LEVEL)
        matches, weights, reasons = self._matches(disparity, saturated, guide, right)
        smoothed = self._median(matches)
        within = extent(smoothed)
        planar, labels, agreed = self._with_planes(smoothed, weights, within, image, disparity.stamp)
        filled, kinds = self._filled(planar, within, image, guide, right)
        guessed = kinds != KEPT
        sharp = self._sharpened(self._bilateral(filled, guide), guessed, *alike(image, other))
        refined, sigma, consistent = self._supported(sharp, guessed, frame)
        source, confidence = label_origin(
            matches, disparity.confidence, agreed, kinds, refined, consistent, reasons, sigma, TRUST
        )  # fmt: skip
        stated = sigma if self.support else None
        return Disparity(frame.stamp, refined, source, confidence, labels, frame.camera, stated)

    def _matches(self, disparity: Disparity, saturated: Array, guide: Array, right: Array) -> tuple[Array, ...]:
        """Trusted matches with subpixel fractions fitted to brightness, their weights, and reasons of the others."""
        matches, weights, reasons = trusted_matches(
            disparity.pixels, disparity.source, disparity.confidence, self.min_confidence, saturated
        )
        if self.subpixel_radius:
            matches = fit_brightness(guide, right, matches, self.subpixel_radius, self.threads)
        return matches, weights, reasons

    def _median(self, matches: Array) -> Array:
        return near_median(matches, self.median_size, MAX_CORRECTION) if self.median_size else matches

    def _with_planes(
        self, pixels: Array, weights: Array, within: Extent, image: Array, seed: int
    ) -> tuple[Array, Array | None, Array]:
        """Matches pulled to their planes and holes filled from them; the superpixels; where a plane agreed."""
        if not (self.plane_weight or self.plane_fill):
            return pixels, None, np.zeros(pixels.shape, bool)
        aimed = max(1, min(self.superpixels, pixels.size // self.min_superpixel_size))
        labels, count = superpixels(image, aimed, self.threads)
        accepted = self._planes(pixels, weights, labels, count, MIN_VALID_SHARE, seed)
        pixels, agreed = self._pulled(pixels, accepted, labels, within, MAX_CORRECTION, self.plane_weight)
        if not self.surface_size:
            return pixels, labels, agreed
        # A region of superpixels is less likely to be flat, so it moves no match, and it is larger, so it needs half
        # the share of matches.
        group, groups = merge_regions(image, labels, count, max(1, count // self.surface_size))
        accepted = self._planes(pixels, weights, group.take(labels), groups, MIN_VALID_SHARE / 2, seed + 1)
        pixels, again = self._pulled(pixels, accepted[group], labels, within, MAX_CORRECTION / 2, 0)
        return pixels, labels, agreed | again

    def _planes(
        self, pixels: Array, weights: Array, labels: Array, count: int, min_valid_share: float, seed: int
    ) -> Array:
        """The coefficients (count, 3) of the supported planes of segments, NaN for the others.

        Every other pixel of every other row is enough, except for small segments.
        """
        spacing = 2 if pixels.size >= MIN_SPARSE_SIZE * count else 1
        pixels, weights, labels = (layer[::spacing, ::spacing].copy() for layer in (pixels, weights, labels))
        pixels[weights == 0] = np.nan  # filled pixels are no evidence for a plane
        planes = fit_planes(pixels, labels, count, weights, self.hypotheses, seed, self.threads)
        accepted = (planes.inlier_share >= MIN_INLIER_SHARE) & (planes.valid_share >= min_valid_share)
        coefficients = planes.coefficients / [spacing, spacing, 1]
        accepted &= np.hypot(coefficients[:, 0], coefficients[:, 1]) <= MAX_GRADIENT
        return np.where(accepted[:, None], coefficients, np.nan)

    def _pulled(
        self, pixels: Array, planes: Array, labels: Array, within: Extent, near: float, weight: float
    ) -> tuple[Array, Array]:
        return pull_to_planes(pixels, planes, labels, within, near, weight, self.plane_fill, MAX_EXTRAPOLATION)

    def _filled(self, pixels: Array, within: Extent, image: Array, guide: Array, right: Array) -> tuple[Array, Array]:
        """The remaining holes filled as far as evidence reaches, (H, W) float32, and their kinds of `holes`."""
        if not self.fill:
            return pixels, np.where(np.isnan(pixels), np.uint8(OCCLUSION), np.uint8(KEPT))
        found = fill_holes(pixels, image, within, MAX_FILL_DISTANCE, MAX_EXTRAPOLATION, self.threads)
        return bridge_holes(pixels, *found, guide, right) if self.bridge else found

    def _bilateral(self, pixels: Array, guide: Array) -> Array:
        if self.bilateral_radius == 0:
            return pixels
        return joint_bilateral(pixels, guide, self.bilateral_radius, self.threads)

    def _supported(self, pixels: Array, guessed: Array, frame: StereoFrame) -> tuple[Array, Array, Array]:
        """The supported disparities, their sigma, px, and where the images agree with them, (H, W) bool."""
        if not self.support:
            return pixels, np.zeros(pixels.shape, np.float32), np.ones(pixels.shape, bool)
        guide, both, noise = frame.once(gray_pair)[0], frame.once(slopes), frame.once(frame_noise)
        floor = SMOOTH_FLOOR if self.bilateral_radius else FLOOR
        found = supported(pixels, guessed, guide, both, noise, floor, self.threads)
        _doubt_black(found.sigma, guide, noise)
        consistent = found.sigma <= F32(self.max_sigma)
        if self.min_correlation:
            consistent &= found.correlation >= F32(self.min_correlation)
        if self.min_support_shift:
            np.copyto(found.pixels, pixels, where=np.abs(found.pixels - pixels) < F32(self.min_support_shift))
        return found.pixels, found.sigma, consistent

    def _sharpened(self, pixels: Array, guessed: Array, image: Array, other: Array) -> Array:
        if self.edge_radius == 0:
            return pixels
        return sharpen_edges(pixels, guessed, image, other, self.edge_radius, self.threads)


def _saturated(image: Array, guide: Array, level: int) -> Array:
    """Where the image is even and saturated in a colour, (H, W) bool: matches there are noise."""
    if image.dtype != np.uint8:  # the saturation level of more bits is unknown
        return np.zeros(guide.shape, bool)
    bright = image >= level if image.ndim == 2 else cv2.inRange(image, (0,) * 3, (level - 1,) * 3) == 0
    return bright & (contrast(guide, 0, len(guide)) <= MAX_EVEN_CONTRAST) if bright.any() else bright


def _doubt_black(sigma: Array, guide: Array, noise: Array) -> None:
    """Take the evidence, in place, where the image is black: a match there is that of the lit ground around.

    noise: (256,) standard deviation at each gray level.
    """
    level = max(BLACK_LEVEL, BLACK_SIGMAS * float(noise[0]))
    if np.count_nonzero(guide <= level) > BLACK_WINDOW**2 // 2:
        black = (cv2.medianBlur(guide, BLACK_WINDOW) <= level).view(np.uint8)
        sigma[cv2.dilate(black, np.ones((2 * BLACK_MARGIN + 1,) * 2, np.uint8)) > 0] = np.inf
