"""The noise of an image, from the image: sensor noise and rounding, by brightness.

A fourth difference in both directions removes slopes, straight edges and most of the texture that a lens shows: in the
smoothest blocks of an image, noise is what remains. Shot noise grows with the light: its variance is a line over the
gray levels.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stages.data import Array, ImageNoise, StereoFrame
from stages.matching.intensity import gray_pair
from stages.stage import Stage, check_types

# Along rows and columns. The lens blurs what it shows of texture; white noise of variance 1 keeps that variance.
FOURTH_DIFFERENCE = np.array([1, -4, 6, -4, 1], np.float32) / np.sqrt(70, dtype=np.float32)
BLOCK = 8  # px, side of the blocks whose mean square response is a sample of the variance
SMOOTH_SHARE = 0.05  # of the blocks of one brightness count as smooth
SMOOTH_VARIANCE = 0.45  # mean square response at that share of blocks of white noise, over its variance
LEVELS, BIN = 256, 16  # gray levels
TEXTURED = 2.0  # a bin whose variance is this many times that of the line contains texture
DARKEST, BRIGHTEST = 4, 244  # mean levels between which clipping does not reduce the noise
MIN_BLOCKS = 60  # of a bin of brightness
MIN_VARIANCE = 1 / 12  # of rounding


@dataclass(frozen=True)
class MeasureNoise(Stage):
    """The noise of a frame's left image, as the standard deviation of a pixel at each gray level.

    References
    ----------
    J. Immerkaer, "Fast Noise Variance Estimation", CVIU 64(2), 1996; A. Foi et al., "Practical Poissonian-Gaussian
    Noise Modeling and Fitting for Single-Image Raw-Data", IEEE TIP 17(10), 2008.

    Examples
    --------
    >>> import numpy as np
    >>> from stages import MeasureNoise, StereoCamera, StereoFrame
    >>> camera = StereoCamera(fx=300.0, fy=300.0, cx=160.0, cy=120.0, baseline=0.1, width=320, height=240)
    >>> image = np.rint(np.random.default_rng(0).normal(120, 2, (240, 320))).astype(np.uint8)
    >>> noise = MeasureNoise()(StereoFrame(0, image, image, camera))
    >>> round(float(noise.sigma[120]), 1)
    2.0
    """

    def __call__(self, frame: StereoFrame) -> ImageNoise:
        """The noise of `frame.left`."""
        check_types(self, frame=frame)
        return ImageNoise(frame.stamp, frame.once(frame_noise))


def frame_noise(frame: StereoFrame) -> Array:
    """`noise_levels` of the left image in gray."""
    return noise_levels(frame.once(gray_pair)[0])


def noise_levels(image: Array) -> Array:
    """Standard deviation of the noise at each gray level, (256,) float32, of an image (H, W) uint8."""
    variance, level = _samples(image)
    if not level.size:  # a black or white image
        return np.full(LEVELS, np.sqrt(MIN_VARIANCE), np.float32)
    by_bin = np.argsort(level // BIN, kind="stable")
    ends = np.cumsum(np.bincount(level // BIN, minlength=LEVELS // BIN))
    groups = [group for group in np.split(by_bin, ends) if len(group) >= MIN_BLOCKS] or [by_bin]
    levels = np.array([level[group].mean() for group in groups])
    smooth = np.array([_quantile(variance[group], SMOOTH_SHARE) for group in groups]) / SMOOTH_VARIANCE
    offset, gain = _line(levels, np.maximum(smooth, MIN_VARIANCE), np.array([len(group) for group in groups]))
    return np.asarray(np.sqrt(MIN_VARIANCE + offset + gain * np.arange(LEVELS)), dtype=np.float32)


def _samples(image: Array) -> tuple[Array, Array]:
    """Mean square response and mean level of the blocks that are not clipped."""
    rows, cols = (extent // BLOCK for extent in image.shape)
    if not rows or not cols:
        return np.zeros(0, np.float32), np.zeros(0, np.uint8)
    whole = image[: rows * BLOCK, : cols * BLOCK]
    response = cv2.sepFilter2D(whole, cv2.CV_32F, FOURTH_DIFFERENCE, FOURTH_DIFFERENCE)
    variance = cv2.resize(response * response, (cols, rows), interpolation=cv2.INTER_AREA).ravel()
    level = cv2.resize(whole, (cols, rows), interpolation=cv2.INTER_AREA).ravel()
    unclipped = (level >= DARKEST) & (level <= BRIGHTEST)
    return variance[unclipped], level[unclipped]


def _quantile(values: Array, share: float) -> float:
    """`np.quantile`, in a third of the time for few values."""
    place = share * (len(values) - 1)
    below, above = int(place), min(int(place) + 1, len(values) - 1)
    low, high = np.partition(values, (below, above))[[below, above]]
    near = place - below
    return float(low + (high - low) * near if near < 0.5 else high - (high - low) * (1 - near))


def _line(level: Array, variance: Array, count: Array) -> tuple[float, float]:
    """Offset and slope, none of them negative, of the variance beyond that of rounding over the gray level.

    level, variance, count: (n,), of the bins; bins far above the line contain texture and are left out.
    """
    weight = np.sqrt(count / variance)
    terms = np.stack([np.ones_like(level), level], axis=1)
    while True:
        offset, gain = nonnegative_pair(terms * weight[:, None], (variance - MIN_VARIANCE) * weight)
        textured = (variance > TEXTURED * (MIN_VARIANCE + terms @ (offset, gain))) & (weight > 0)
        if not textured.any() or textured[weight > 0].all():
            return float(offset), float(gain)
        weight = np.where(textured, 0.0, weight)


def nonnegative_pair(terms: Array, values: Array) -> tuple[float, float]:
    """The two numbers, none of them negative, that fit `terms`, (n, 2), to `values`, (n,), by least squares.

    The same as `scipy.optimize.nnls`, which takes long to import.
    """
    both, _, rank, _ = np.linalg.lstsq(terms, values)
    if rank == 2 and (both >= 0).all():
        return float(both[0]), float(both[1])
    # The best pair is at the border: one of them is 0, of equals the first.
    squares = np.maximum(np.square(terms).sum(axis=0), np.finfo(np.float64).tiny)
    alone = np.diag(np.maximum(values @ terms / squares, 0))
    errors = [float(np.square(terms @ pair - values).sum()) for pair in alone]
    offset, gain = alone[0] if errors[0] < errors[1] - 1e-12 * float(values @ values) else alone[1]
    return float(offset), float(gain)
