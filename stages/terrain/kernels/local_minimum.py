"""How far every cell of a height grid rises above the lowest cell within a wheel's reach, slopes discounted.

No ground has to be found for that: a rock is a step beside its own foot, be the ground about it known or not. What the
given slope of the surroundings explains is taken off, so that a plane has no step however it is tilted.
"""

from __future__ import annotations

from functools import reduce

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array


def lowest_around(heights: Array, use: Array, trend: Array, radius: int) -> tuple[Array, Array]:
    """The lowest of the cells about each cell, as it would lie were it moved there along the trend.

    heights: (rows, cols) float64, finite where `use`; use: (rows, cols) bool, the cells that count; trend: (2, rows,
    cols) float64, finite, the slope about each cell, rise per cell along columns (x) and rows (y); radius: cells, of a
    disc.

    Returns two (rows, cols) float64: that height, NaN where `use` is not, at most the cell's own; and the share of the
    disc's cells that count, those beyond the grid's border being missing.
    """
    shape = heights.shape
    lowest, share = np.full(shape, np.nan), np.zeros(shape)
    framed = np.pad(np.where(use, heights, np.inf), ((0, 0), (radius, radius)), constant_values=np.inf)
    count = np.pad(np.cumsum(use, axis=1, dtype=np.int32), ((0, 0), (radius + 1, 0)))
    count = np.pad(count, ((0, 0), (0, radius)), mode="edge")
    disc = _disc(radius)
    reach = np.array([disc[disc[:, 0] == row, 1].max() for row in range(-radius, radius + 1)])
    _lowest_around(framed, count, np.ascontiguousarray(use), np.ascontiguousarray(trend), reach, lowest, share)
    return lowest, share


def _disc(radius: int) -> Array:
    """Offsets (row, column) within `radius`, half a cell more at the corners, (N, 2) int64."""
    rows, cols = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    inside = rows**2 + cols**2 <= (radius + 0.3) ** 2
    return np.ascontiguousarray(np.column_stack([rows[inside], cols[inside]]))


@kernel
def _lowest_around(heights, count, use, trend, reach, lowest, share):
    """heights: infinite where not in use, with `radius` more columns to either side; count: of cells in use, up to and
    with one column less; reach: of the disc along columns, in each of its rows. One offset at a time for a whole row,
    so that the processor takes several cells at once."""
    rows, cols = use.shape
    radius = len(reach) // 2
    size = (2 * reach + 1).sum()
    least, found = np.empty(cols), np.empty(cols, np.int32)
    for row in range(rows):
        least[:] = np.inf
        found[:] = 0
        east, north = trend[0, row], trend[1, row]
        for other in range(max(row - radius, 0), min(row + radius + 1, rows)):
            far, y = reach[other - row + radius], np.float64(other - row)
            before, after = count[other, radius - far :], count[other, radius + far + 1 :]
            for col in range(cols):
                found[col] += after[col] - before[col]
            for offset in range(-far, far + 1):
                beside, x = heights[other, radius + offset :], np.float64(offset)
                for col in range(cols):
                    height = beside[col] - east[col] * x - north[col] * y
                    least[col] = height if height < least[col] else least[col]
        for col in range(cols):
            if use[row, col]:
                lowest[row, col] = least[col]
                share[row, col] = found[col] / size


def lowest_around_reference(heights: Array, use: Array, trend: Array, radius: int) -> tuple[Array, Array]:
    """The same as `lowest_around`, in plain numpy: the grid shifted once for every cell of the disc."""
    around = np.pad(np.where(use, heights, np.nan), radius, constant_values=np.nan)
    rows, cols = heights.shape
    moved = [
        around[radius + dr : radius + dr + rows, radius + dc : radius + dc + cols] - trend[0] * dc - trend[1] * dr
        for dr, dc in _disc(radius)
    ]
    lowest = reduce(np.fmin, moved)
    share = np.isfinite(moved).mean(axis=0)
    return np.where(use, lowest, np.nan), np.where(use, share, 0.0)
