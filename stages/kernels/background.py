"""Row-wise background fill: what lies left and right of a hole in the disparity image, whichever is farther.

A surface hidden from one camera lies behind the one that hides it, so a hole takes the smaller of the disparities at
its two ends. The hole that an edge causes is as wide as the edge's disparity step: beyond that width plus `reach`, or
with nothing known at one end, there is no evidence and the hole stays.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from stages.data import Array


def fill_background(disparity: Array, reach: float) -> Array:
    """Fill the holes of each row that evidence explains.

    disparity: (H, W) float32, px, NaN = unknown; reach: px that a hole may be wider than the disparity step between
    its ends; infinite fills every hole, also those at the image's border from their one end. Returns (H, W) float32.
    """
    filled = np.ascontiguousarray(disparity, np.float32).copy()
    _fill(filled, float(reach))
    return filled


@njit(nogil=True, cache=True)
def _fill(disparity, reach):  # type: ignore[no-untyped-def]
    height, width = disparity.shape
    for y in range(height):
        row = disparity[y]
        last = -1
        for x in range(width + 1):
            if x < width and np.isnan(row[x]):
                continue
            if x - last > 1 and not (last < 0 and x == width):
                left = row[last] if last >= 0 else np.float32(np.inf)
                right = row[x] if x < width else np.float32(np.inf)
                if x - last - 1 <= reach + abs(right - left) and (reach == np.inf or (last >= 0 and x < width)):
                    row[last + 1 : x] = min(left, right)
            last = x


def fill_background_reference(disparity: Array, reach: float) -> Array:
    """`fill_background` in plain numpy."""
    known = np.isfinite(disparity)
    column = np.arange(disparity.shape[1])
    left = np.maximum.accumulate(np.where(known, column, -1), axis=1)
    right = np.flip(np.minimum.accumulate(np.flip(np.where(known, column, len(column)), axis=1), axis=1), axis=1)
    padded = np.pad(disparity, ((0, 0), (1, 1)), constant_values=np.inf)
    before, after = np.take_along_axis(padded, left + 1, axis=1), np.take_along_axis(padded, right + 1, axis=1)
    inside = (left >= 0) & (right < len(column)) if np.isfinite(reach) else (left >= 0) | (right < len(column))
    with np.errstate(invalid="ignore"):
        explained = ~known & inside & (right - left - 1 <= reach + np.abs(after - before))
    return np.where(explained, np.minimum(before, after), disparity).astype(np.float32)
