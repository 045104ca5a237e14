"""Lowest neighbour of every cell of a height grid within a disc, with the trend removed.

A rock is a step beside its own foot, even if the ground around it is unknown. The slope of the surroundings is
subtracted, so a tilted plane has no step.
"""

from __future__ import annotations

from functools import reduce

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array
from stages.terrain.kernels.plane_window import span


def local_minimum(heights: Array, use: Array, trend: Array, radius: int) -> tuple[Array, Array]:
    """The lowest height in the disc around each cell, each moved to the cell along the trend.

    heights: (rows, cols) float64, finite where `use`; use: (rows, cols) bool, the cells that count; trend: (2, rows,
    cols) float64, finite, rise per cell along columns (x) and rows (y); radius: of the disc, cells.

    Returns two (rows, cols) float64: that height, NaN where `use` is False; and the share of the disc's cells that
    count.
    """
    rows, cols = heights.shape
    framed, count = np.full((rows, cols + 2 * radius), np.inf), np.zeros((rows, cols + 2 * radius + 1), np.int32)
    np.copyto(framed[:, radius : radius + cols], heights, where=use)
    np.cumsum(use, axis=1, out=count[:, radius + 1 : radius + 1 + cols])
    count[:, radius + 1 + cols :] = count[:, radius + cols, None]
    reach = np.sqrt((radius + 0.3) ** 2 - np.arange(-radius, radius + 1) ** 2).astype(np.int64)
    lowest, share = np.full(heights.shape, np.nan), np.zeros(heights.shape)
    _local_minimum(framed, count, np.ascontiguousarray(use), np.ascontiguousarray(trend), reach, lowest, share)
    return lowest, share


def _disc(radius: int) -> Array:
    """Offsets (row, column) within `radius` + 0.3 cells, (N, 2) int64."""
    rows, cols = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    inside = rows**2 + cols**2 <= (radius + 0.3) ** 2
    return np.ascontiguousarray(np.column_stack([rows[inside], cols[inside]]))


@kernel
def _local_minimum(heights, count, use, trend, reach, lowest, share):
    """One offset at a time for all cells of a row that are in use, so that the loop is vectorised.

    heights: inf where not in use, padded by `radius` columns; count: running sum of cells in use; reach: half width of
    the disc in each of its rows."""
    rows, cols = use.shape
    radius = len(reach) // 2
    size = (2 * reach + 1).sum()
    minimum, found = np.empty(cols), np.empty(cols, np.int32)
    for row in range(rows):
        begin, end = span(use[row])
        minimum[:] = np.inf
        found[:] = 0
        east, north = trend[0, row, begin:end], trend[1, row, begin:end]
        for other in range(max(row - radius, 0), min(row + radius + 1, rows)):
            far, y = reach[other - row + radius], np.float64(other - row)
            before, after = count[other, begin + radius - far :], count[other, begin + radius + far + 1 :]
            for col in range(east.size):
                found[col] += after[col] - before[col]
            for offset in range(-far, far + 1):
                beside, x = heights[other, begin + radius + offset :], np.float64(offset)
                for col in range(east.size):
                    height = beside[col] - east[col] * x - north[col] * y
                    minimum[col] = height if height < minimum[col] else minimum[col]
        for col in range(east.size):
            if use[row, begin + col]:
                lowest[row, begin + col] = minimum[col]
                share[row, begin + col] = found[col] / size


def local_minimum_reference(heights: Array, use: Array, trend: Array, radius: int) -> tuple[Array, Array]:
    """The same as `local_minimum`, in plain numpy: one shift of the grid for every cell of the disc."""
    around = np.pad(np.where(use, heights, np.nan), radius, constant_values=np.nan)
    rows, cols = heights.shape
    moved = [
        around[radius + dr : radius + dr + rows, radius + dc : radius + dc + cols] - trend[0] * dc - trend[1] * dr
        for dr, dc in _disc(radius)
    ]
    lowest = reduce(np.fmin, moved)
    share = np.isfinite(moved).mean(axis=0)
    return np.where(use, lowest, np.nan), np.where(use, share, 0.0)
