"""Images as matching and segmentation want them: 8 bit, and gray.

A camera of 10 or 12 bit leaves the upper bits of its 16 unused. Its images are stretched by what they hold, not by what
they could hold; the percentiles come from a histogram, which costs one pass where sorting would cost many.
"""

from __future__ import annotations

import cv2
import numpy as np

from stages.data import Array

DARKEST, BRIGHTEST = 0.001, 0.999  # shares of the values that may fall below and above the range kept


def eight_bit(*images: Array) -> tuple[Array, ...]:
    """The images, of one exposure, as uint8; 16-bit ones are stretched jointly, 0.1th to 99.9th percentile.

    images: uint8 or uint16, (H, W) or (H, W, 3); where all are uint8 they are returned as they are.
    """
    if all(image.dtype == np.uint8 for image in images):
        return images
    counts = sum(np.bincount(image.ravel(), minlength=2**16) for image in images)
    reached = np.cumsum(counts)
    low, high = np.searchsorted(reached, np.array([DARKEST, BRIGHTEST]) * reached[-1])
    stretched = (np.arange(2**16) - low) * (255 / max(high - low, 1)) + 0.5
    table = np.clip(stretched, 0, 255).astype(np.uint8)
    return tuple(table[image] for image in images)


def gray(image: Array) -> Array:
    """A gray or RGB uint8 image as gray (H, W) uint8."""
    luma: Array = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return luma
