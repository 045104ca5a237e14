"""Blank windows: where the 5x5 window of the census shows one gray value only, nothing can be matched, and what the
paths carry there (into a burnt-out sky, say) is no measurement.

The largest and the smallest of a window are those of its columns: five rows first, then five columns, 64 pixels at a
time. OpenCV's morphology takes half as long again; what counts is its temporary images, 3 MB at 1280x960.
"""

from __future__ import annotations

import cv2
import numpy as np

from stages.data import Array
from stages.kernels.compiled import kernel
from stages.kernels.vectors import Width, greater, lanes_in, lesser, load, spread, store, where_less

BLOCK = 64


def blank_windows(image: Array) -> Array:
    """Whether the window of each pixel is blank, 1 or 0.

    image: (H, W) uint8, its own border replicated beyond. Returns (H, W rounded up to 64) uint8, arbitrary beyond W.
    """
    height, width = image.shape
    columns = -(-width // BLOCK) * BLOCK
    padded = cv2.copyMakeBorder(image, 2, 2, 2, 2 + columns - width + BLOCK, cv2.BORDER_REPLICATE)
    blank = np.empty((height, columns), np.uint8)
    _find(padded, blank, np.empty((2, padded.shape[1]), np.uint8), Width(BLOCK))
    return blank


@kernel
def _find(image, blank, extremes, width):  # type: ignore[no-untyped-def]
    height, columns = blank.shape
    largest, smallest = extremes
    yes, no = spread(1, width), spread(0, width)
    for y in range(height):
        for x in range(0, columns + lanes_in(width), lanes_in(width)):
            most = least = load(image[y], x, width)
            for down in range(1, 5):
                row = load(image[y + down], x, width)
                most, least = greater(most, row), lesser(least, row)
            store(largest, x, most)
            store(smallest, x, least)
        for x in range(0, columns, lanes_in(width)):
            most, least = load(largest, x, width), load(smallest, x, width)
            for across in range(1, 5):
                most = greater(most, load(largest, x + across, width))
                least = lesser(least, load(smallest, x + across, width))
            store(blank[y], x, where_less(least, most, no, yes))


def blank_windows_reference(image: Array) -> Array:
    """The same, (H, W) bool, by OpenCV."""
    return np.asarray(cv2.morphologyEx(image, cv2.MORPH_GRADIENT, np.ones((5, 5), np.uint8)) == 0)


@kernel
def drop_blank(blank, partner, pixels, evidence):  # type: ignore[no-untyped-def]
    """Forget, in place, matches of pixels that are blank, or whose partner is.

    blank, partner: of `blank_windows` of the left and of the right image; pixels: (H, W) float32, px, disparities;
    evidence: (H, W) uint8, 0 where there is none.
    """
    last = pixels.shape[1] - 1
    for y in range(pixels.shape[0]):
        for x in range(pixels.shape[1]):
            if evidence[y, x] > 0 and (blank[y, x] or partner[y, min(max(round(x - pixels[y, x]), 0), last)]):
                pixels[y, x], evidence[y, x] = np.nan, 0
