"""Blank windows: where the 5x5 window of the census shows one gray value only, nothing can be matched, and what the
paths carry there (into a burnt-out sky, say) is no measurement.
"""

from __future__ import annotations

import cv2
import numpy as np

from stages.compiled.jit import kernel
from stages.compiled.parallel import with_margin
from stages.data import Array

WINDOW = 5  # px, of the census


def contrast(image: Array, first: int, end: int) -> Array:
    """By how much the gray levels in the windows of the pixels of rows first to end of an image (H, W) uint8 differ,
    (end - first, W) uint8."""
    rows, own = with_margin(image, first, end, WINDOW // 2)
    return np.asarray(cv2.morphologyEx(rows, cv2.MORPH_GRADIENT, np.ones((WINDOW, WINDOW), np.uint8))[own])


def blank_windows(image: Array, first: int, end: int) -> Array:
    """Whether the windows of the pixels of rows first to end are blank, (end - first, W) bool."""
    return np.asarray(contrast(image, first, end) == 0)


@kernel
def drop_blank(blank, partner, pixels, evidence):
    """Forget, in place, matches of pixels that are blank, or whose partner is.

    blank, partner: of `blank_windows` of the left and of the right image; pixels: (H, W) float32, px, disparities;
    evidence: (H, W) uint8, 0 where there is none.
    """
    last = pixels.shape[1] - 1
    for y in range(pixels.shape[0]):
        for x in range(pixels.shape[1]):
            if evidence[y, x] > 0 and (blank[y, x] or partner[y, min(max(round(x - pixels[y, x]), 0), last)]):
                pixels[y, x], evidence[y, x] = np.nan, 0
