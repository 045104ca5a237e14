"""RefinePaper: the paper's refinement as it stands (sections 3.2 and 3.3): SLIC, RANSAC planes, WLS, bilateral.

`stages.Refine` is more accurate; this stage is for comparison on the same log. Where the paper gives no value, the
parameters are those of the authors' released code.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.data import Array, Disparity, PixelOrigin, StereoFrame, known
from stages.matching.intensity import eight_bit, gray
from stages.refinement.kernels.bilateral import joint_bilateral
from stages.refinement.kernels.plane_apply import near_median
from stages.refinement.kernels.wls import smooth
from stages.stage import Stage, check_confidence, check_joined, check_same_time, parameter

F32 = np.float32
UNLIMITED = 1e9  # px: the median replaces every match
MIN_WEIGHT = 0.05  # WLS weight of a match, however low its confidence
PLANE_CONFIDENCE, FILLED_CONFIDENCE = 0.8, 0.6  # not calibrated: the paper states none
COMPACTNESS = 10.0  # SLIC's first weight of position against colour
TRIALS = 100  # planes that RANSAC tries in a superpixel
MIN_MATCHES, MIN_MATCHED_SHARE = 20, 0.2  # for a plane; the share is that of the mean superpixel
WLS_LAMBDA, WLS_SIGMA = 8000.0, 1.0  # weight of smoothness; gray levels over which the coupling falls to 1/e
MEASURED_WITHIN = 1.0  # px; largest correction of a match that stays MEASURED


@dataclass(frozen=True)
class RefinePaper(Stage):
    """RANSAC planes replace the matches of each superpixel, WLS fills the holes, and a bilateral filter smooths.

    A match is MEASURED where its plane is within 1 px, else PLANE. A filled hole is FILLED.

    References
    ----------
    Lu et al., Stereovision Image Processing for Planetary Navigation Maps with Semi-Global Matching and Superpixel
    Segmentation, arXiv 2509.05645, sections 3.2 and 3.3.

    Examples
    --------
    >>> import numpy as np
    >>> from stages import Disparity, RefinePaper, StereoCamera, StereoFrame
    >>> camera = StereoCamera(fx=50.0, fy=50.0, cx=20.0, cy=15.0, baseline=0.1, width=40, height=30)
    >>> image = np.add.outer(np.arange(30), np.arange(40)).astype(np.uint8)
    >>> pixels = np.full((30, 40), 5, np.float32)
    >>> pixels[10:14, 20:24] = np.nan
    >>> matched = Disparity(0, pixels, np.isfinite(pixels).astype(np.uint8), np.ones((30, 40), np.float32))
    >>> refined = RefinePaper(superpixels=12)(StereoFrame(0, image, image, camera), matched)
    >>> bool(np.allclose(refined.pixels, 5)), np.unique(refined.source).tolist()
    (True, [1, 3])
    """

    superpixels: int = parameter(4000, "number of superpixels that SLIC aims at", low=1)
    bilateral_radius: int = parameter(2, "radius of the bilateral filter; 0: none", unit="px", low=0, high=32)
    median_size: int = parameter(
        5, "median filter before the planes and at the end (authors' code, not in the text); 0: none", unit="px",
        choices=(0, 3, 5),
    )  # fmt: skip

    def __call__(self, frame: StereoFrame, disparity: Disparity) -> Disparity:
        """Refine `disparity`, the left disparity of the rectified `frame`."""
        check_joined(self, frame, disparity)
        check_same_time(self, frame=frame.stamp, disparity=disparity.stamp)
        check_confidence(self, disparity)
        image, _ = eight_bit(frame.left, frame.right)
        guide = gray(image)
        matches = np.where(disparity.source == PixelOrigin.MEASURED, disparity.pixels, F32(np.nan))
        labels = self._segmented(image)
        planar = self._planar(self._median(matches), labels, disparity.stamp)
        filled = self._filled(planar, disparity.confidence, guide)
        refined = self._median(self._bilateral(filled, guide))
        source, confidence = self._labelled(disparity, matches, refined)
        return Disparity(frame.stamp, refined, source, confidence, labels, frame.camera)

    def _segmented(self, image: Array) -> Array:
        """SLIC superpixels, labels from 0, (H, W) int32."""
        from skimage.segmentation import slic  # takes long to import, and the other pipelines need none of it

        channels = None if image.ndim == 2 else -1
        labels: Array = slic(  # in float32, which takes half the memory of skimage's own conversion
            image / F32(255), n_segments=self.superpixels, compactness=COMPACTNESS, slic_zero=True, start_label=0,
            channel_axis=channels,
        )  # fmt: skip
        return labels.astype(np.int32)

    def _planar(self, matches: Array, labels: Array, seed: int) -> Array:
        """The matches of each superpixel replaced by its RANSAC plane, (H, W) float32; holes stay NaN."""
        planar, random = matches.copy(), np.random.default_rng(seed % 2**64)
        known = np.flatnonzero(np.isfinite(matches))
        order = known[np.argsort(labels.ravel()[known], kind="stable")]
        sizes = np.bincount(labels.ravel()[known], minlength=labels.max() + 1)
        enough = max(MIN_MATCHES, MIN_MATCHED_SHARE * labels.size / (labels.max() + 1))
        for pixels in np.split(order, np.cumsum(sizes)[:-1]):
            if len(pixels) > enough:
                y, x = np.divmod(pixels, labels.shape[1])
                values = matches.ravel()[pixels].astype(np.float64)
                planar.ravel()[pixels] = self._plane(x - x.mean(), y - y.mean(), values, random)
        return planar

    def _plane(self, x: Array, y: Array, values: Array, random: np.random.Generator) -> Array:
        """The values on the plane of most inliers among `TRIALS` through three points each, refitted to its inliers.

        An inlier deviates by at most the median absolute deviation of the superpixel's matches.
        """
        points = np.stack([x, y, np.ones(len(x))])
        limit = np.median(np.abs(values - np.median(values)))
        chosen = random.integers(0, len(x), (TRIALS, 3))
        corners = points.T[chosen]
        proper = np.abs(np.linalg.det(corners)) > 0.5  # twice the area of the triangle, px^2: not on a line
        if not proper.any():
            return values
        planes = np.linalg.solve(corners[proper], values[chosen[proper]][..., None])[..., 0]
        inliers = np.abs(planes @ points - values) <= limit
        best = inliers[np.argmax(inliers.sum(axis=1))]
        fitted, *_ = np.linalg.lstsq(points[:, best].T, values[best], rcond=None)
        return np.asarray(fitted @ points)

    def _filled(self, pixels: Array, confidence: Array, guide: Array) -> Array:
        """The holes filled by confidence-weighted least squares, (H, W) float32; NaN where no evidence reaches."""
        hole = np.isnan(pixels)
        weights = np.where(hole, F32(0), np.maximum(confidence, F32(MIN_WEIGHT)))
        return np.where(hole, smooth(pixels, weights, guide, WLS_LAMBDA, WLS_SIGMA), pixels)

    def _bilateral(self, pixels: Array, guide: Array) -> Array:
        if self.bilateral_radius == 0:
            return pixels
        return joint_bilateral(pixels, guide, self.bilateral_radius, plain=True)

    def _median(self, pixels: Array) -> Array:
        return near_median(pixels, self.median_size, UNLIMITED) if self.median_size else pixels

    def _labelled(self, disparity: Disparity, matches: Array, refined: Array) -> tuple[Array, Array]:
        """Origin and confidence of each pixel; a pixel that stays unknown keeps its reason."""
        near = np.abs(refined - matches) <= MEASURED_WITHIN  # False where either is NaN
        plane = np.isfinite(matches) & ~near
        origin = np.select([near, plane], [PixelOrigin.MEASURED, PixelOrigin.PLANE], PixelOrigin.FILLED)
        trust = np.select([near, plane], [disparity.confidence, F32(PLANE_CONFIDENCE)], F32(FILLED_CONFIDENCE))
        finite = np.isfinite(refined)
        reasons = np.where(known(disparity.source), PixelOrigin.UNKNOWN, disparity.source)
        source = np.where(finite, origin, reasons).astype(np.uint8)
        return source, np.where(finite, trust, 0).astype(np.float32)
