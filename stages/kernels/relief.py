"""How far every cell of a height grid rises above the lowest cell within a wheel's reach, slopes discounted.

No ground has to be found for that: a rock is a step beside its own foot, be the ground about it known or not. What the
given slope of the surroundings explains is taken off, so that a plane has no step however it is tilted.
"""

from __future__ import annotations

import numpy as np

from stages.data import Array
from stages.kernels.compiled import kernel


def lowest_around(heights: Array, use: Array, trend: Array, radius: int) -> tuple[Array, Array]:
    """The lowest of the cells about each cell, as it would lie were it moved there along the trend.

    heights: (rows, cols) float64, finite where `use`; use: (rows, cols) bool, the cells that count; trend: (2, rows,
    cols) float64, the slope about each cell, rise per cell along columns (x) and rows (y); radius: cells, of a disc.

    Returns two (rows, cols) float64: that height, NaN where `use` is not, at most the cell's own; and the share of the
    disc's cells that count, those beyond the grid's border being missing.
    """
    return _lowest_around(  # type: ignore[no-any-return]
        np.ascontiguousarray(heights), np.ascontiguousarray(use), np.ascontiguousarray(trend), _disc(radius)
    )


def _disc(radius: int) -> Array:
    """Offsets (row, column) within `radius`, half a cell more at the corners, (N, 2) int64."""
    rows, cols = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    inside = rows**2 + cols**2 <= (radius + 0.3) ** 2
    return np.ascontiguousarray(np.column_stack([rows[inside], cols[inside]]))


@kernel
def _lowest_around(heights, use, trend, disc):  # type: ignore[no-untyped-def]
    rows, cols = heights.shape
    lowest = np.full((rows, cols), np.nan)
    share = np.zeros((rows, cols))
    for row in range(rows):
        for col in range(cols):
            if not use[row, col]:
                continue
            least, found = heights[row, col], 0
            east, north = trend[0, row, col], trend[1, row, col]
            for k in range(disc.shape[0]):
                r, c = row + disc[k, 0], col + disc[k, 1]
                if r < 0 or c < 0 or r >= rows or c >= cols or not use[r, c]:
                    continue
                found += 1
                least = min(least, heights[r, c] - east * disc[k, 1] - north * disc[k, 0])
            lowest[row, col] = least
            share[row, col] = found / disc.shape[0]
    return lowest, share


def lowest_around_reference(heights: Array, use: Array, trend: Array, radius: int) -> tuple[Array, Array]:
    """The same as `lowest_around`, in plain numpy: the grid shifted once for every cell of the disc."""
    around = np.pad(np.where(use, heights, np.nan), radius, constant_values=np.nan)
    rows, cols = heights.shape
    moved = [
        around[radius + dr : radius + dr + rows, radius + dc : radius + dc + cols] - trend[0] * dc - trend[1] * dr
        for dr, dc in _disc(radius)
    ]
    lowest = np.fmin.reduce(moved)
    share = np.isfinite(moved).mean(axis=0)
    return np.where(use, lowest, np.nan), np.where(use, share, 0.0)
