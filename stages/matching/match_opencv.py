"""Semi-global matching (Hirschmüller, 2008; section 3.1 of the paper), by OpenCV's StereoSGBM.

The images are widened to the left by the disparity range, because StereoSGBM returns no disparities in the left margin.
Matches whose partner lies outside the right image are dropped.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import cv2
import numpy as np

from flow.contracts import StageError
from stages.data import Array, Disparity, PixelOrigin, StereoFrame
from stages.matching.intensity import alike, eight_bit, gray
from stages.stage import Stage, check_rectified, parameter

F32 = np.float32
MODES = {3: cv2.STEREO_SGBM_MODE_SGBM_3WAY, 5: cv2.STEREO_SGBM_MODE_SGBM, 8: cv2.STEREO_SGBM_MODE_HH}
MIN_SIDE = 32
DENSITY_WINDOW = 31  # px, side of the window in which the share of known disparities is counted
HALF_CONFIDENCE_DEVIATION = 0.5  # px from the local median that halve the confidence
UNKNOWN_LEVEL = -1e4  # stands for unknown in the median, so a pixel surrounded by holes agrees with none


@dataclass(frozen=True)
class MatchOpenCV(Stage):
    """Disparities of a rectified frame by OpenCV's StereoSGBM, to 1/16 px.

    `disparities` is rounded up to a multiple of 16. The confidence is a heuristic, not a probability: it falls with the
    share of unknown pixels in the neighbourhood and with the distance from the local median. On the quarter-size
    Middlebury scenes it ranks wrong matches better than texture or photometric difference.

    References
    ----------
    https://docs.opencv.org/4.x/d2/d85/classcv_1_1StereoSGBM.html

    Examples
    --------
    >>> import numpy as np
    >>> from stages import MatchOpenCV, StereoCamera, StereoFrame
    >>> scene = np.random.default_rng(0).integers(0, 256, (48, 85), np.uint8)
    >>> camera = StereoCamera(fx=100, fy=100, cx=40, cy=24, baseline=0.1, width=80, height=48)
    >>> disparity = MatchOpenCV(disparities=16)(StereoFrame(0, scene[:, :80], scene[:, 5:], camera))
    >>> float(np.nanmedian(disparity.pixels))
    5.0
    """

    disparities: int = parameter(192, "size of the search range", unit="px", low=16, high=1024)
    min_disparity: int = parameter(0, "smallest disparity searched", unit="px", low=-512, high=512)
    paths: int = parameter(5, "directions of aggregation", choices=(3, 5, 8))
    block_size: int = parameter(
        3, "side of the block that a matching cost is summed over, odd", unit="px", low=1, high=9
    )
    p1: float = parameter(2.0, "penalty of a step of 1 px, times channels * block^2 (as in the authors' code)", low=0.1)
    p2: float = parameter(24.0, "penalty of a larger step, times channels * block^2; above p1", low=0)
    prefilter_cap: int = parameter(
        63, "largest horizontal gradient that the matching cost distinguishes, gray levels", low=1, high=63
    )
    uniqueness: int = parameter(1, "margin in percent by which the best cost must beat the next", low=0, high=100)
    lr_tolerance: int = parameter(1, "largest left-right difference", unit="px", low=1, high=64)
    max_speckle_size: int = parameter(100, "largest isolated patch that is dropped, in pixels", low=0, high=10**9)
    speckle_range: int = parameter(1, "disparity step that separates patches", unit="px", low=1)
    color: bool = parameter(False, "match on RGB instead of gray")

    large = True  # StereoSGBM keeps the sums of all paths of the whole frame

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.block_size % 2 == 0:
            raise ValueError(f"MatchOpenCV.block_size must be odd, not {self.block_size}")
        if not self.p2 > self.p1:
            raise ValueError(f"MatchOpenCV.p2 must be above MatchOpenCV.p1 = {self.p1}, not {self.p2}")
        scale = (3 if self.color else 1) * self.block_size**2
        if scale * (2 * self.prefilter_cap + 63 + self.p2) > np.iinfo(np.int16).max:
            raise ValueError("MatchOpenCV: block costs could exceed 16 bits; use a smaller block, p2 or prefilter")

    def __call__(self, frame: StereoFrame) -> Disparity:
        """The left disparity of the rectified `frame`."""
        check_rectified(self, frame)
        left, right = eight_bit(frame.left, frame.right)
        pixels, source = self._matched(*alike(left, right)) if self.color else self._matched(gray(left), gray(right))
        bare = _texture(gray(left), self.block_size) == 0
        pixels[bare], source[bare] = np.nan, PixelOrigin.BLANK
        return Disparity(frame.stamp, pixels, source, _agreement(pixels, np.isfinite(pixels)), camera=frame.camera)

    def _matched(self, left: Array, right: Array) -> tuple[Array, Array]:
        """The disparity image (H, W) float32, NaN where the match failed or lies outside the right image, and its
        source. StereoSGBM does not report why the uniqueness or left-right check failed: that is UNKNOWN.
        """
        height, width = left.shape[:2]
        if min(height, width) < MIN_SIDE:
            raise StageError(f"MatchOpenCV: images are {width}x{height}, each side must be at least {MIN_SIDE} px")
        levels = -(-self.disparities // 16) * 16
        before, after = max(0, self.min_disparity + levels), max(0, -self.min_disparity)
        left, right = (
            cv2.copyMakeBorder(image, 0, 0, before, after, cv2.BORDER_REPLICATE) for image in (left, right)
        )  # fmt: skip
        scale = (1 if left.ndim == 2 else 3) * self.block_size**2
        _release_freed_memory()
        # A matcher keeps its buffers and is not re-entrant; a new one for each frame costs little.
        matcher = cv2.StereoSGBM.create(
            minDisparity=self.min_disparity, numDisparities=levels, blockSize=self.block_size,
            P1=max(1, round(self.p1 * scale)), P2=round(self.p2 * scale), disp12MaxDiff=self.lr_tolerance,
            preFilterCap=self.prefilter_cap, uniquenessRatio=self.uniqueness,
            speckleWindowSize=0, mode=MODES[self.paths],
        )  # fmt: skip
        sixteenths, lowest = matcher.compute(left, right), 16 * self.min_disparity
        source = np.where(sixteenths < lowest, np.uint8(PixelOrigin.UNKNOWN), np.uint8(PixelOrigin.SPECKLE))
        if self.max_speckle_size:  # as StereoSGBM does it
            cv2.filterSpeckles(sixteenths, lowest - 16, self.max_speckle_size, 16 * self.speckle_range)
        sixteenths, source = (layer[:, before : before + width] for layer in (sixteenths, source))
        pixels: Array = sixteenths.astype(np.float32) / F32(16)
        partner = np.arange(width, dtype=np.float32) - pixels
        found, in_view = sixteenths >= lowest, (partner >= 0) & (partner <= width - 1)
        # The columns whose partners lie outside the right image at every disparity are out of view as well.
        unseen = (found & ~in_view) | (np.arange(width) < self.min_disparity)
        unseen |= np.arange(width) > width - 1 + self.min_disparity + levels - 1
        source = np.select([unseen, found], [np.uint8(PixelOrigin.OUT_OF_VIEW), np.uint8(PixelOrigin.MEASURED)], source)
        pixels[~(found & in_view)] = np.nan
        return pixels, source


def _release_freed_memory() -> None:
    """Return free pages of the heap to the system (glibc only): StereoSGBM takes 0.9 GB of 1280x960 outside of it."""
    release = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if release is not None:
        release(0)


def _texture(image: Array, block: int) -> Array:
    """Mean absolute horizontal gradient of the block around each pixel, gray levels, (H, W) float32."""
    gradient = np.abs(cv2.Sobel(image, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8))
    texture: Array = cv2.blur(gradient, (block, block))
    return texture


def _agreement(pixels: Array, known: Array) -> Array:
    """The agreement of each disparity with its neighbours, (H, W) float32 in [0, 1]; 0 where unknown."""
    median = cv2.medianBlur(np.where(known, pixels, F32(UNKNOWN_LEVEL)), 5)
    density = cv2.blur(known.astype(np.float32), (DENSITY_WINDOW, DENSITY_WINDOW))
    with np.errstate(invalid="ignore"):
        agreement = density**4 / (1 + np.abs(median - pixels) / F32(HALF_CONFIDENCE_DEVIATION))
    return np.where(known, np.minimum(agreement, 1), F32(0))
