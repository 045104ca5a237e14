"""Cell statistics of points over a regular grid, in one pass (paper section 4, "voxelisation").

The six running figures of a cell are adjacent in memory, so a point touches one cache line. Sums are float64.
Percentiles need one sort of all points by cell and height.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array

FIGURES = ("count", "sum", "sum_of_squares", "minimum", "maximum", "noise")


class Grid(NamedTuple):
    """A square grid; points at a larger horizontal range from (0, 0) than `max_range`, m, are left out."""

    resolution: float  # m
    origin: tuple[float, float]  # (x, y) of the corner of cell [0, 0], m
    size: int  # rows and columns
    max_range: float


def cell_statistics(points: Array, sigma: Array, grid: Grid) -> Array:
    """Figures of the heights in each cell.

    points: (N, 3) float32, m; sigma: (N,) float32, depth standard deviation of each point, m.

    Returns (size, size, 6) float64, the figures named in `FIGURES`; `noise` is the sum of the squares of `sigma`.
    Cells without points contain 0, 0, 0, inf, -inf, 0.
    """
    resolution, (x0, y0), size, max_range = grid
    cells, raster = no_figures(size), (1.0 / resolution, float(x0), float(y0), float(max_range))
    _cell_statistics(np.ascontiguousarray(points), np.ascontiguousarray(sigma), raster, cells)
    return cells


def no_figures(size: int) -> Array:
    """The figures of cells without points, (size, size, 6) float64."""
    cells = np.zeros((size, size, 6))
    cells[:, :, 3], cells[:, :, 4] = np.inf, -np.inf
    return cells


@kernel
def add_point(cell, z, sigma):
    """Add a point to the six figures of its cell."""
    cell[0] += 1.0
    cell[1] += z
    cell[2] += z * z
    cell[3] = min(cell[3], z)
    cell[4] = max(cell[4], z)
    cell[5] += sigma * sigma


@kernel
def _cell_statistics(points, sigma, raster, cells):
    cells_per_metre, x0, y0, max_range = raster
    size = cells.shape[0]
    for i in range(points.shape[0]):
        # numba's float() of a float32 stays a float32.
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        if not (x * x + y * y <= max_range * max_range and np.isfinite(z)):
            continue
        col = int(np.floor((x - x0) * cells_per_metre))
        row = int(np.floor((y - y0) * cells_per_metre))
        if row < 0 or row >= size or col < 0 or col >= size:
            continue
        add_point(cells[row, col], z, np.float64(sigma[i]))


def cell_statistics_reference(points: Array, sigma: Array, grid: Grid) -> Array:
    """The same as `cell_statistics`, in plain numpy."""
    flat, inside = _cells_of(points, grid)
    z = points[inside, 2].astype(np.float64)
    total = grid.size * grid.size
    cells = no_figures(grid.size).reshape(total, 6)
    for figure, weight in ((0, np.ones(len(z))), (1, z), (2, z * z), (5, sigma[inside].astype(np.float64) ** 2)):
        cells[:, figure] = np.bincount(flat, weight, minlength=total)
    np.minimum.at(cells[:, 3], flat, z)
    np.maximum.at(cells[:, 4], flat, z)
    return cells.reshape(grid.size, grid.size, 6)


def cell_percentile(points: Array, percentile: float, grid: Grid) -> Array:
    """A percentile of each cell's heights, interpolated as numpy does, (size, size) float32, NaN without points."""
    flat, inside = _cells_of(points, grid)
    z = points[inside, 2]
    order = np.lexsort((z, flat))
    flat, z = flat[order], z[order].astype(np.float64)
    cell, start, count = np.unique(flat, return_index=True, return_counts=True)
    rank = percentile / 100 * (count - 1)
    below = np.floor(rank).astype(np.int64)
    low, high = z[start + below], z[start + np.minimum(below + 1, count - 1)]
    heights = np.full(grid.size * grid.size, np.nan, np.float32)
    heights[cell] = low + (rank - below) * (high - low)
    return heights.reshape(grid.size, grid.size)


def _cells_of(points: Array, grid: Grid) -> tuple[Array, Array]:
    """Flat cell index of the points on the grid, and which points those are, (N,) bool."""
    p = points.astype(np.float64)
    col, row = (np.floor((p[:, axis] - grid.origin[axis]) * (1.0 / grid.resolution)) for axis in (0, 1))
    inside = (p[:, 0] ** 2 + p[:, 1] ** 2 <= grid.max_range**2) & np.isfinite(p[:, 2])
    inside &= (row >= 0) & (row < grid.size) & (col >= 0) & (col < grid.size)
    return (row[inside] * grid.size + col[inside]).astype(np.int64), inside
