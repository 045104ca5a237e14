"""Removal of sensor noise before a match: fine detail is kept as far as its power exceeds that of the noise.

The costs of a match compare neighbours, so noise reaches them undamped. Where the detail of a neighbourhood has little
more power than noise alone, it says nothing about the disparity (J.-S. Lee, "Digital Image Enhancement and Noise
Filtering by Use of Local Statistics", PAMI 2(2), 1980).
"""

from __future__ import annotations

import cv2
import numpy as np

from stages.data import Array

SCALE, KERNEL = 1.0, (7, 7)  # px: standard deviation and window of the Gaussian that separates detail from the rest
NEIGHBOURHOOD = (5, 5)  # px, over which the power of the detail is measured
# Gray levels. Removing weaker noise costs a match more in fine texture than it gains, on indoor scenes above all.
HARMLESS_NOISE = 1.25


def denoised(images: tuple[Array, Array], noise: Array) -> tuple[Array, Array]:
    """The images of a pair with less noise; where none of the noise does harm, the very same images.

    images: left and right, (H, W) uint8; noise: (256,) float32, its standard deviation at each gray level.
    """
    excess = np.maximum(np.square(noise) - np.float32(HARMLESS_NOISE**2), 0)
    if not excess[: int(images[0].max()) + 1].any():
        return images
    variance = excess * np.float32(_variance_of_detail())
    left, right = (_denoised(image, variance) for image in images)
    return left, right


def _denoised(image: Array, variance: Array) -> Array:
    """An image (H, W) uint8 without noise whose `variance` in the detail is given at each gray level, (256,)."""
    pixels = image.astype(np.float32)
    smooth = cv2.GaussianBlur(pixels, KERNEL, SCALE)
    detail = np.subtract(pixels, smooth, out=pixels)
    power = cv2.sqrBoxFilter(detail, cv2.CV_32F, NEIGHBOURHOOD)
    noise = cv2.LUT(image, variance)
    noise_share = np.minimum(noise, power, out=noise)
    noise_share /= np.maximum(power, np.float32(1e-6), out=power)
    smooth += np.multiply(np.subtract(1, noise_share, out=noise_share), detail, out=detail)
    return cv2.convertScaleAbs(np.maximum(smooth, 0, out=smooth))


def _variance_of_detail() -> float:
    """The variance of the detail of white noise of variance 1."""
    row = cv2.getGaussianKernel(KERNEL[0], SCALE)
    weights = row @ row.T
    return float(1 - 2 * weights.max() + (weights**2).sum())
