"""The valid extent of a disparity image: the first and last known pixel of each row, the first of each column.

Above the extent is the sky. Left and right of it is ground that one camera does not see. Small isolated patches are
ignored, because mismatches in the sky make many.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from stages.compiled.jit import kernel
from stages.data import Array

SPECK_WINDOW = 15  # px, side of the window in which known pixels are counted
MIN_RELATIVE_DENSITY = 0.5  # of the image's density; a pixel in a window of less is ignored


class Extent(NamedTuple):
    """First and last known pixels of a disparity image (H, W). Without any, first > last and top = H."""

    top: Array  # (W,) int64, uppermost known row of each column
    first: Array  # (H,) int64, first known column of each row
    last: Array  # (H,) int64, last known column of each row


def extent(disparity: Array) -> Extent:
    """The valid extent of a disparity image, (H, W) float32, NaN = unknown."""
    height, width = disparity.shape
    known = ~np.isnan(disparity)
    least = int(MIN_RELATIVE_DENSITY * SPECK_WINDOW**2 * (np.count_nonzero(known) / known.size))
    found = Extent(np.full(width, height, np.int64), np.full(height, 2 * width, np.int64), np.full(height, -width))
    window, border = (SPECK_WINDOW, SPECK_WINDOW), cv2.BORDER_REPLICATE
    around = cv2.boxFilter(known.view(np.uint8), cv2.CV_16U, window, normalize=False, borderType=border)
    known &= around > least
    _find_ends(known, *found)
    return found


@kernel
def _find_ends(known, top, first, last):
    width = known.shape[1]
    missing = width  # columns without a known pixel so far
    for y in range(known.shape[0]):
        row = known[y]
        x = 0
        while x < width and not row[x]:
            x += 1
        if x == width:
            continue
        first[y] = x
        x = width - 1
        while not row[x]:
            x -= 1
        last[y] = x
        if missing > 0:
            for x in range(first[y], last[y] + 1):
                if row[x] and y < top[x]:
                    top[x] = y
                    missing -= 1


def extent_reference(disparity: Array) -> Extent:
    """`extent` in plain numpy."""
    known = np.isfinite(disparity)
    height, width = known.shape
    around = sliding_window_view(np.pad(known, SPECK_WINDOW // 2, mode="edge"), (SPECK_WINDOW, SPECK_WINDOW)).sum(
        axis=(2, 3)
    )
    known &= around > np.floor(MIN_RELATIVE_DENSITY * SPECK_WINDOW**2 * known.mean())
    rows, columns = known.any(axis=1), known.any(axis=0)
    last = width - 1 - known[:, ::-1].argmax(axis=1)
    return Extent(
        np.where(columns, known.argmax(axis=0), height), np.where(rows, known.argmax(axis=1), 2 * width),
        np.where(rows, last, -width),
    )  # fmt: skip
