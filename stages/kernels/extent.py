"""How far the evidence of a disparity image reaches, and which unknown pixels are within it.

What lies above all that is known in a column is the sky, and what lies beyond the known ends of a row was not seen by
both cameras: there a guess may reach a little farther, not more.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from stages.data import Array
from stages.kernels.compiled import kernel


class Extent(NamedTuple):
    """How far the evidence reaches, of a disparity image (H, W). Where there is none, first > last, top = H."""

    top: Array  # (W,) int64, the uppermost row in which a column is known
    first: Array  # (H,) int64, the first column in which a row is known
    last: Array  # (H,) int64, the last one


def extent(disparity: Array) -> Extent:
    """How far what is known reaches. disparity: (H, W) float32, NaN = unknown."""
    height, width = disparity.shape
    found = Extent(np.full(width, height, np.int64), np.full(height, 4 * width, np.int64), np.full(height, -4 * width))
    _find_top(disparity, found.top)
    _find_ends(disparity, found.first, found.last)
    return found


def within_reach(disparity: Array, within: Extent, reach: float, margin: float) -> Array:
    """Where a pixel is known at most `reach` px away, and `margin` px beyond the evidence at the most, (H, W) bool."""
    row, column = np.arange(disparity.shape[0])[:, np.newaxis], np.arange(disparity.shape[1])
    near: Array = cv2.distanceTransform(np.isnan(disparity).astype(np.uint8), cv2.DIST_L2, 5) <= reach
    near &= (row >= within.top - margin) & (column >= within.first[:, np.newaxis] - margin)
    near &= column <= within.last[:, np.newaxis] + margin
    return near


@kernel
def _find_top(disparity, top):  # type: ignore[no-untyped-def]
    missing = top.size
    for y in range(disparity.shape[0]):
        if missing == 0:
            break
        for x in range(top.size):
            d = disparity[y, x]
            if d == d and y < top[x]:
                top[x] = y
                missing -= 1


@kernel
def _find_ends(disparity, first, last):  # type: ignore[no-untyped-def]
    width = disparity.shape[1]
    for y in range(disparity.shape[0]):
        row = disparity[y]
        x = 0
        while x < width and row[x] != row[x]:
            x += 1
        if x == width:
            continue
        first[y] = x
        x = width - 1
        while row[x] != row[x]:
            x -= 1
        last[y] = x


def extent_reference(disparity: Array) -> Extent:
    """`extent` in plain numpy."""
    known = np.isfinite(disparity)
    height, width = known.shape
    rows, columns = known.any(axis=1), known.any(axis=0)
    last = width - 1 - known[:, ::-1].argmax(axis=1)
    return Extent(
        np.where(columns, known.argmax(axis=0), height), np.where(rows, known.argmax(axis=1), 4 * width),
        np.where(rows, last, -4 * width),
    )  # fmt: skip
