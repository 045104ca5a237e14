"""8-bit and gray images for matching and segmentation.

A 10 or 12 bit camera leaves the upper bits of 16 unused, so its images are stretched by their own percentiles. The
percentiles come from a histogram, which needs one pass instead of a sort.
"""

from __future__ import annotations

import cv2
import numpy as np

from stages.data import Array, StereoFrame

BLACK_SHARE, WHITE_SHARE = 0.001, 0.999  # shares of the values at and below the black and the white level


def eight_bit(*images: Array) -> tuple[Array, ...]:
    """The images, of one exposure, as uint8; 16-bit ones are stretched jointly, 0.1th to 99.9th percentile.

    images: uint8 or uint16, (H, W) or (H, W, 3). If all are uint8, they are returned unchanged.
    """
    if all(image.dtype == np.uint8 for image in images):
        return images
    counts = sum(np.bincount(image.ravel(), minlength=2**16) for image in images)
    cumulative = np.cumsum(counts)
    low, high = np.searchsorted(cumulative, np.array([BLACK_SHARE, WHITE_SHARE]) * cumulative[-1])
    stretched = (np.arange(2**16) - low) * (255 / max(high - low, 1)) + 0.5
    table = np.clip(stretched, 0, 255).astype(np.uint8)
    return tuple(table[image] for image in images)


def gray_pair(frame: StereoFrame) -> tuple[Array, Array]:
    """The images of a frame as gray (H, W) uint8."""
    left, right = (gray(image) for image in eight_bit(frame.left, frame.right))
    return left, right


def alike(left: Array, right: Array) -> tuple[Array, Array]:
    """Two uint8 images as they are; if only one of them is gray, both gray."""
    return (left, right) if left.ndim == right.ndim else (gray(left), gray(right))


def gray(image: Array) -> Array:
    """A gray or RGB uint8 image as gray (H, W) uint8."""
    luma: Array = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return luma
