"""Whether the images bear a disparity out: do they, so shifted, vary alike about it?

Noise matches noise somewhere, and a smooth surface can be laid through what it matches: in a clear sky, on a dark or a
bare patch. But there the two images vary differently. What counts is the change from column to column, for of a change
from row to row, as at the horizon, every shift along the row makes the same. All sums are of whole numbers.
"""

from __future__ import annotations

import cv2
import numpy as np

from stages.compiled.jit import kernel, part
from stages.compiled.parallel import by_bands, shared_by
from stages.data import Array

RADIUS = 7  # px, of the square over which is correlated
# Change along a row, of the image smoothed a little, which takes more from noise than from texture.
ACROSS, DOWN = np.array([1, 2, 0, -2, -1], np.float32), np.array([1, 2, 1], np.float32)
HALF = 0.5  # of that: the sum of squares over a square then stays well below 2^31


def correlation(disparity: Array, guessed: Array, left: Array, right: Array, threads: int = 1) -> Array:
    """Correlation of the images' changes along the row about each pixel, (H, W) float32, -1 to 1; 0 where nothing
    varies, or no disparity about it leads into the right image.

    disparity: (H, W) float32, px, NaN = unknown; guessed: (H, W) bool, where it has no say; left, right: (H, W) uint8;
    threads: 2 share the work, to the same result.
    """
    both, height = shared_by(threads), len(disparity)
    changes = both(lambda: _changes(left), lambda: _changes(right))
    products, found = np.empty((3, *disparity.shape), np.int32), np.empty(disparity.shape, np.float32)
    by_bands(both, height, lambda first, end: _multiply(disparity, guessed, *changes, first, end, products))
    by_bands(both, height, lambda first, end: _correlate(products, first, end, found))
    return found


def _changes(image: Array) -> Array:
    """The changes, (H, W) int16."""
    return cv2.sepFilter2D(image, cv2.CV_16S, HALF * ACROSS, DOWN, borderType=cv2.BORDER_REPLICATE)


@kernel
def _multiply(disparity, guessed, left, right, first, end, products):
    """Squares of the left and of the right change, and their product; 0 where there is no partner."""
    width = disparity.shape[1]
    for y in range(first, end):
        for x in range(width):
            at = np.float32(x) - disparity[y, x]
            products[0, y, x] = products[1, y, x] = products[2, y, x] = 0
            if np.float32(0) <= at <= np.float32(width - 1) and not guessed[y, x]:
                before = int(at)
                here, beside = np.float32(right[y, before]), np.float32(right[y, min(before + 1, width - 1)])
                other = np.int32(np.rint(here + (at - np.float32(before)) * (beside - here)))
                one = np.int32(left[y, x])
                products[0, y, x], products[1, y, x], products[2, y, x] = one * one, other * other, one * other


@part
def _add(columns, products, y, sign):
    for k in range(3):
        for x in range(columns.shape[1]):
            columns[k, x] += np.int32(sign) * products[k, y, x]


@kernel
def _correlate(products, first, end, found):
    height, width = found.shape
    columns = np.zeros((3, width), np.int32)  # sums over the rows of the square
    # Sums along the row so far. They may run over 2^31; the difference of two, of a square, is right all the same.
    along = np.zeros((3, width + 2 * RADIUS + 1), np.int32)
    for y in range(max(first - RADIUS, 0), min(first + RADIUS, height)):
        _add(columns, products, y, 1)
    for y in range(first, end):
        if y + RADIUS < height:
            _add(columns, products, y + RADIUS, 1)
        if y > first and y - RADIUS > 0:
            _add(columns, products, y - RADIUS - 1, -1)
        for k in range(3):
            total = np.int32(0)
            for x in range(width):
                total = np.int32(total + columns[k, x])
                along[k, x + RADIUS + 1] = total
            along[k, width + RADIUS + 1 :] = total
        for x in range(width):
            left = np.float64(np.int32(along[0, x + 2 * RADIUS + 1] - along[0, x]))
            right = np.float64(np.int32(along[1, x + 2 * RADIUS + 1] - along[1, x]))
            mixed = np.float64(np.int32(along[2, x + 2 * RADIUS + 1] - along[2, x]))
            found[y, x] = mixed / np.sqrt(max(left * right, 1.0))  # where either is 0, so is mixed


def correlation_reference(disparity: Array, guessed: Array, left: Array, right: Array) -> Array:
    """`correlation` in plain numpy, one square at a time."""
    height, width = disparity.shape
    one, changes = (_changes(image).astype(np.float32) for image in (left, right))
    at = np.arange(width, dtype=np.float32) - disparity
    inside = (at >= 0) & (at <= width - 1) & ~guessed
    at = np.where(inside, at, 0)
    row, before = np.arange(height)[:, None], at.astype(int)
    here, beside = changes[row, before], changes[row, np.minimum(before + 1, width - 1)]
    other = np.rint(here + (at - before.astype(np.float32)) * (beside - here))
    found = np.zeros(disparity.shape, np.float32)
    for y, x in np.ndindex(height, width):
        square = np.s_[max(y - RADIUS, 0) : y + RADIUS + 1, max(x - RADIUS, 0) : x + RADIUS + 1]
        a, b = (change[square][inside[square]].astype(np.float64) for change in (one, other))
        found[y, x] = a @ b / np.sqrt(max((a @ a) * (b @ b), 1.0))
    return found
