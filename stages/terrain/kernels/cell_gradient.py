"""How the cells of a height grid lie to the four beside them: slope, and height off their mean.

Where one of two opposite neighbours is missing the slope is that to the other one; where both are, there is none.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array


def gradient_and_curvature(heights: Array) -> Array:
    """Slopes and bend at every cell.

    heights: (rows, cols) float64, NaN = unknown.

    Returns (3, rows, cols) float64: the rise per cell along columns (x) and along rows (y), 0 without neighbours there,
    and the height above the mean of the neighbours, 0 without any; NaN where the cell itself is unknown.
    """
    return _lie_of_cells(np.ascontiguousarray(heights))  # type: ignore[no-any-return]


@kernel
def _lie_of_cells(heights):
    rows, cols = heights.shape
    lie = np.full((3, rows, cols), np.nan)
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
                lie[axis, row, col] = rise / sides if sides else 0.0
            lie[2, row, col] = here - total / found if found else 0.0
    return lie


def lie_of_cells_reference(heights: Array) -> Array:
    """The same as `gradient_and_curvature`, in plain numpy."""
    around = np.pad(heights, 1, constant_values=np.nan)
    west, east, south, north = around[1:-1, :-2], around[1:-1, 2:], around[:-2, 1:-1], around[2:, 1:-1]

    def mean(*parts: Array) -> Array:
        stack = np.stack(parts)
        known = np.isfinite(stack)
        return np.asarray(np.where(known, stack, 0).sum(0) / np.maximum(known.sum(0), 1))

    lie = np.stack([mean(east - heights, heights - west), mean(north - heights, heights - south),
                    -mean(*(side - heights for side in (west, east, south, north)))])  # fmt: skip
    return np.where(np.isnan(heights), np.nan, lie)
