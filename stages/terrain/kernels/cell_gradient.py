"""Gradient and curvature of a height grid, from the four neighbours of each cell.

The slope is the mean of those to the two opposite neighbours, or the one that exists, or 0.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array


def gradient_and_curvature(heights: Array) -> Array:
    """Rise per cell along columns (x) and rows (y), and height above the mean of the neighbours.

    heights: (rows, cols) float64, NaN = unknown. Returns (3, rows, cols) float64, NaN where the cell is unknown and 0
    without neighbours.
    """
    return _gradient_and_curvature(np.ascontiguousarray(heights))  # type: ignore[no-any-return]


@kernel
def _gradient_and_curvature(heights):
    rows, cols = heights.shape
    result = np.full((3, rows, cols), np.nan)
    for row in range(rows):
        for col in range(cols):
            here = heights[row, col]
            if np.isnan(here):
                continue
            total, found = 0.0, 0
            for axis in range(2):
                rise, sides = 0.0, 0
                for sign in (-1, 1):
                    r, c = row + sign * axis, col + sign * (1 - axis)
                    if r < 0 or c < 0 or r >= rows or c >= cols or np.isnan(heights[r, c]):
                        continue
                    rise += sign * (heights[r, c] - here)
                    total += heights[r, c]
                    sides += 1
                found += sides
                result[axis, row, col] = rise / sides if sides else 0.0
            result[2, row, col] = here - total / found if found else 0.0
    return result


def gradient_and_curvature_reference(heights: Array) -> Array:
    """The same as `gradient_and_curvature`, in plain numpy."""
    around = np.pad(heights, 1, constant_values=np.nan)
    west, east, south, north = around[1:-1, :-2], around[1:-1, 2:], around[:-2, 1:-1], around[2:, 1:-1]

    def mean(*parts: Array) -> Array:
        stack = np.stack(parts)
        known = np.isfinite(stack)
        return np.asarray(np.where(known, stack, 0).sum(0) / np.maximum(known.sum(0), 1))

    result = np.stack([mean(east - heights, heights - west), mean(north - heights, heights - south),
                       -mean(*(side - heights for side in (west, east, south, north)))])  # fmt: skip
    return np.where(np.isnan(heights), np.nan, result)
