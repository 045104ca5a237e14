"""Matches that are no measurement: of blank windows, and of pixels that are excluded from the search.

A window of the census (5x5) that has one gray value only cannot be matched. The paths carry disparities of other pixels
into such a patch, for example into a burnt-out sky.
"""

from __future__ import annotations

import cv2
import numpy as np

from stages.compiled.jit import kernel
from stages.compiled.parallel import with_margin
from stages.data import Array, PixelOrigin

BLANK = int(PixelOrigin.BLANK)
WINDOW = 5  # px, of the census


def contrast(image: Array, first: int, end: int) -> Array:
    """The range of the gray levels in the window of each pixel of rows first to end, (end - first, W) uint8.

    image: (H, W) uint8.
    """
    rows, own = with_margin(image, first, end, WINDOW // 2)
    return np.asarray(cv2.morphologyEx(rows, cv2.MORPH_GRADIENT, np.ones((WINDOW, WINDOW), np.uint8))[own])


@kernel
def drop_unmatchable(contrast_left, contrast_right, excluded, pixels, evidence, source):
    """Drop, in place, the matches of excluded pixels, of blank windows and of pixels whose partner's window is blank.

    A pixel that is excluded or blank gets that reason whether it has a match or not.
    contrast_left, contrast_right: (H, W) uint8 of `contrast`; excluded: (H, W) uint8, why the pixel has no match in the
    range, a code of `PixelOrigin`, or 0; it may have no rows, which excludes nothing; pixels: (H, W) float32, px;
    evidence: (H, W) uint8; source: (H, W) uint8, codes of `PixelOrigin`.
    """
    last = pixels.shape[1] - 1
    for y in range(pixels.shape[0]):
        for x in range(pixels.shape[1]):
            reason = excluded[y, x] if excluded.shape[0] > 0 else np.uint8(0)
            if reason == 0 and contrast_left[y, x] == 0:
                reason = np.uint8(BLANK)
            if reason == 0 and evidence[y, x] > 0:
                partner = min(max(round(x - pixels[y, x]), 0), last)
                reason = np.uint8(BLANK) if contrast_right[y, partner] == 0 else reason
            if reason != 0:
                pixels[y, x], evidence[y, x], source[y, x] = np.nan, 0, reason


def drop_unmatchable_reference(
    contrast_left: Array, contrast_right: Array, excluded: Array, pixels: Array, evidence: Array, source: Array
) -> None:
    """`drop_unmatchable` in plain numpy."""
    columns = np.arange(pixels.shape[1])
    partner = np.clip(np.rint(columns - np.nan_to_num(pixels.astype(np.float64))), 0, columns[-1]).astype(int)
    blank = (contrast_left == 0) | ((evidence > 0) & (np.take_along_axis(contrast_right, partner, axis=1) == 0))
    reason = np.where(blank, np.uint8(BLANK), np.uint8(0))
    if len(excluded):
        reason = np.where(excluded > 0, excluded, reason)
    dropped = reason > 0
    pixels[dropped], evidence[dropped], source[dropped] = np.nan, 0, reason[dropped]
