"""Whether the images bear a disparity out: do they, so shifted, vary alike about it?

Noise matches noise somewhere, and a smooth surface can be laid through what it matches: in a clear sky, on a dark or a
bare patch. But there the two images vary differently. What counts is the change from column to column, for of a change
from row to row, as at the horizon, every shift along the row makes the same. All sums are of whole numbers.
"""

from __future__ import annotations

import cv2
import numpy as np

from stages.data import Array
from stages.kernels.compiled import kernel
from stages.kernels.halves import by_halves, shared_by

RADIUS = 7  # px, of the square over which is correlated
# Change along a row, of the image smoothed a little, which takes more from noise than from texture.
ACROSS, DOWN = np.array([1, 2, 0, -2, -1], np.float32), np.array([1, 2, 1], np.float32)
HALF = 0.5  # of that, so that the sum of squares over a square is below 2^31


def correlation(disparity: Array, left: Array, right: Array, threads: int = 1) -> Array:
    """Correlation of the images' changes along the row about each pixel, (H, W) float32, -1 to 1; 0 where nothing
    varies, or no disparity about it leads into the right image.

    disparity: (H, W) float32, px, NaN = unknown; left, right: (H, W) uint8; threads: 2 share the work, to the same
    result.
    """
    both, height = shared_by(threads), len(disparity)
    changes = both(lambda: _changes(left), lambda: _changes(right))
    products, found = np.empty((3, *disparity.shape), np.int32), np.empty(disparity.shape, np.float32)
    by_halves(both, height, lambda first, end: _multiply(disparity, *changes, first, end, products))
    by_halves(both, height, lambda first, end: _correlate(products, first, end, found))
    return found


def _changes(image: Array) -> Array:
    """The changes, (H, W) int16."""
    return cv2.sepFilter2D(image, cv2.CV_16S, HALF * ACROSS, DOWN, borderType=cv2.BORDER_REPLICATE)


@kernel
def _multiply(disparity, left, right, first, end, products):  # type: ignore[no-untyped-def]
    """Squares of the left and of the right change, and their product; 0 where there is no partner."""
    width = disparity.shape[1]
    for y in range(first, end):
        for x in range(width):
            at = np.float32(x) - disparity[y, x]
            products[0, y, x] = products[1, y, x] = products[2, y, x] = 0
            if np.float32(0) <= at <= np.float32(width - 1):
                before = int(at)
                here, beside = np.float32(right[y, before]), np.float32(right[y, min(before + 1, width - 1)])
                other = np.int32(np.rint(here + (at - np.float32(before)) * (beside - here)))
                one = np.int32(left[y, x])
                products[0, y, x], products[1, y, x], products[2, y, x] = one * one, other * other, one * other


@kernel
def _correlate(products, first, end, found):  # type: ignore[no-untyped-def]
    height, width = found.shape
    columns = np.zeros((3, width), np.int32)  # sums over the rows of the square
    for y in range(max(first - RADIUS, 0), min(first + RADIUS, height)):
        columns += products[:, y]
    for y in range(first, end):
        if y + RADIUS < height:
            columns += products[:, y + RADIUS]
        if y > first and y - RADIUS > 0:
            columns -= products[:, y - RADIUS - 1]
        left = right = mixed = np.int64(0)
        for ahead in range(-RADIUS, width):
            if ahead + RADIUS < width:
                left += columns[0, ahead + RADIUS]
                right += columns[1, ahead + RADIUS]
                mixed += columns[2, ahead + RADIUS]
            if ahead - RADIUS > 0:
                left -= columns[0, ahead - RADIUS - 1]
                right -= columns[1, ahead - RADIUS - 1]
                mixed -= columns[2, ahead - RADIUS - 1]
            if ahead >= 0:
                scale = np.sqrt(np.float64(left) * np.float64(right))
                found[y, ahead] = np.float64(mixed) / scale if scale > 0 else np.float64(0)


def correlation_reference(disparity: Array, left: Array, right: Array) -> Array:
    """`correlation` in plain numpy, one square at a time."""
    height, width = disparity.shape
    one, changes = (_changes(image).astype(np.float32) for image in (left, right))
    at = np.arange(width, dtype=np.float32) - disparity
    inside = (at >= 0) & (at <= width - 1)
    at = np.where(inside, at, 0)
    row, before = np.arange(height)[:, None], at.astype(int)
    here, beside = changes[row, before], changes[row, np.minimum(before + 1, width - 1)]
    other = np.rint(here + (at - before.astype(np.float32)) * (beside - here))
    found = np.zeros(disparity.shape, np.float32)
    for y, x in np.ndindex(height, width):
        square = np.s_[max(y - RADIUS, 0) : y + RADIUS + 1, max(x - RADIUS, 0) : x + RADIUS + 1]
        a, b = (change[square][inside[square]].astype(np.float64) for change in (one, other))
        scale = np.sqrt((a @ a) * (b @ b))
        found[y, x] = a @ b / scale if scale > 0 else 0.0
    return found
