"""Gradient and curvature of a height grid, from the four neighbours of each cell.

The slope is the mean of those to the two opposite neighbours, or the one that exists, or 0.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel, part
from stages.data import Array


@part
def _known(value):
    return 0.0 if np.isnan(value) else value


@part
def _slope(before, here, after):
    sides = 2 - np.isnan(before) - np.isnan(after)
    return (_known(here - before) + _known(after - here)) / max(sides, 1)


@part
def gradient_at(heights, row, col):
    """The three numbers of a known cell, without branches, because holes may be anywhere."""
    here = heights[row, col]
    west = heights[row, col - 1] if col > 0 else np.nan
    east = heights[row, col + 1] if col + 1 < heights.shape[1] else np.nan
    south = heights[row - 1, col] if row > 0 else np.nan
    north = heights[row + 1, col] if row + 1 < heights.shape[0] else np.nan
    found = 4 - np.isnan(west) - np.isnan(east) - np.isnan(south) - np.isnan(north)
    total = _known(west) + _known(east) + _known(south) + _known(north)
    return _slope(west, here, east), _slope(south, here, north), here - total / found if found else 0.0


@kernel
def gradient_and_curvature(heights):
    """Rise per cell along columns (x) and rows (y), and height above the mean of the neighbours.

    heights: (rows, cols) float64, NaN = unknown. Returns (3, rows, cols) float64, NaN where the cell is unknown and 0
    without neighbours.
    """
    result = np.full((3, *heights.shape), np.nan)
    for row in range(heights.shape[0]):
        for col in range(heights.shape[1]):
            if not np.isnan(heights[row, col]):
                result[:, row, col] = gradient_at(heights, row, col)
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
