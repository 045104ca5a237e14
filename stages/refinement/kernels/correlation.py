"""Normalised cross-correlation (NCC) of the images' row gradients at each disparity.

Noise matches noise somewhere, and a smooth surface may pass through such matches: in a clear sky, on a dark or blank
patch. There the two images do not correlate. Only gradients along the row count: a gradient across rows, as at the
horizon, looks the same at every disparity. All sums are of whole numbers.
"""

from __future__ import annotations

import cv2
import numpy as np

from stages.compiled.jit import kernel, part
from stages.compiled.parallel import by_bands, shared_by
from stages.data import Array

WINDOW_RADIUS = 7  # px
# Gradient along the row of a slightly smoothed image: smoothing removes more noise than texture.
DERIVATIVE, SMOOTHING = np.array([1, 2, 0, -2, -1], np.float32), np.array([1, 2, 1], np.float32)
GRADIENT_SCALE = 0.5  # keeps the sum of squares over a window well below 2^31


def correlation(disparity: Array, guessed: Array, left: Array, right: Array, threads: int = 1) -> Array:
    """NCC in a window around each pixel, (H, W) float32, -1 to 1; 0 without texture or without a partner.

    disparity: (H, W) float32, px, NaN = unknown; guessed: (H, W) bool, pixels to leave out; left, right: (H, W) uint8.
    """
    both, height = shared_by(threads), len(disparity)
    gradients = both(lambda: _gradient(left), lambda: _gradient(right))
    products, found = np.empty((3, *disparity.shape), np.int32), np.empty(disparity.shape, np.float32)
    by_bands(both, height, lambda first, end: _write_products(disparity, guessed, *gradients, first, end, products))
    by_bands(both, height, lambda first, end: _correlate(products, first, end, found))
    return found


def _gradient(image: Array) -> Array:
    """Gradient along the row, (H, W) int16."""
    return cv2.sepFilter2D(image, cv2.CV_16S, GRADIENT_SCALE * DERIVATIVE, SMOOTHING, borderType=cv2.BORDER_REPLICATE)


@kernel
def _write_products(disparity, guessed, left, right, first, end, products):
    """Squares of the left and the right gradient, and their product; 0 without a partner."""
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
    columns = np.zeros((3, width), np.int32)  # sums over the rows of the window
    # Running sums along the row. They may overflow; the difference of two over a window is exact all the same.
    along = np.zeros((3, width + 2 * WINDOW_RADIUS + 1), np.int32)
    for y in range(max(first - WINDOW_RADIUS, 0), min(first + WINDOW_RADIUS, height)):
        _add(columns, products, y, 1)
    for y in range(first, end):
        if y + WINDOW_RADIUS < height:
            _add(columns, products, y + WINDOW_RADIUS, 1)
        if y > first and y - WINDOW_RADIUS > 0:
            _add(columns, products, y - WINDOW_RADIUS - 1, -1)
        for k in range(3):
            total = np.int32(0)
            for x in range(width):
                total = np.int32(total + columns[k, x])
                along[k, x + WINDOW_RADIUS + 1] = total
            along[k, width + WINDOW_RADIUS + 1 :] = total
        for x in range(width):
            left = np.float64(np.int32(along[0, x + 2 * WINDOW_RADIUS + 1] - along[0, x]))
            right = np.float64(np.int32(along[1, x + 2 * WINDOW_RADIUS + 1] - along[1, x]))
            mixed = np.float64(np.int32(along[2, x + 2 * WINDOW_RADIUS + 1] - along[2, x]))
            found[y, x] = mixed / np.sqrt(max(left * right, 1.0))  # where either is 0, so is mixed


def correlation_reference(disparity: Array, guessed: Array, left: Array, right: Array) -> Array:
    """`correlation` in plain numpy, one window at a time."""
    height, width = disparity.shape
    one, gradients = (_gradient(image).astype(np.float32) for image in (left, right))
    at = np.arange(width, dtype=np.float32) - disparity
    inside = (at >= 0) & (at <= width - 1) & ~guessed
    at = np.where(inside, at, 0)
    row, before = np.arange(height)[:, None], at.astype(int)
    here, beside = gradients[row, before], gradients[row, np.minimum(before + 1, width - 1)]
    other = np.rint(here + (at - before.astype(np.float32)) * (beside - here))
    found = np.zeros(disparity.shape, np.float32)
    for y, x in np.ndindex(height, width):
        square = np.s_[
            max(y - WINDOW_RADIUS, 0) : y + WINDOW_RADIUS + 1, max(x - WINDOW_RADIUS, 0) : x + WINDOW_RADIUS + 1
        ]
        a, b = (change[square][inside[square]].astype(np.float64) for change in (one, other))
        found[y, x] = a @ b / np.sqrt(max((a @ a) * (b @ b), 1.0))
    return found
