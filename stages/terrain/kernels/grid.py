"""Cell statistics of points over a regular grid, in one pass (paper section 4, "voxelisation").

The six running figures of a cell are adjacent in memory, so a point touches one cache line. Sums are float64.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stages.compiled.jit import kernel, part
from stages.data import Array
from stages.data.arrays import Span

FIGURES = ("count", "sum", "sum_of_squares", "minimum", "maximum", "noise")


class Grid(NamedTuple):
    """A window of a grid; points at a larger horizontal range from (0, 0) than `max_range`, m, are left out."""

    resolution: float  # m
    origin: tuple[float, float]  # (x, y) of the corner of the whole grid, m
    shape: tuple[int, int]  # rows and columns of the window
    max_range: float
    first: tuple[int, int] = (0, 0)  # row and column of the window in the whole grid

    @property
    def raster(self) -> tuple[float, float, float, float, int, int, int, int]:
        """The same as numbers, for `cell_of`."""
        x0, y0 = map(float, self.origin)
        return (1.0 / self.resolution, x0, y0, float(self.max_range), *self.first, *self.shape)

    @property
    def within(self) -> Span:
        """Rows and columns of the window in the whole grid."""
        rows, cols = (slice(at, at + cells) for at, cells in zip(self.first, self.shape, strict=True))
        return rows, cols

    @property
    def middles(self) -> tuple[Array, Array]:
        """x and y of the cells' centres, (1, cols) and (rows, 1), m."""
        row, col = (first + np.arange(cells) + 0.5 for first, cells in zip(self.first, self.shape, strict=True))
        return col[None, :] * self.resolution + self.origin[0], row[:, None] * self.resolution + self.origin[1]


def cell_statistics(points: Array, sigma: Array, grid: Grid) -> Array:
    """Figures of the heights in each cell.

    points: (N, 3) float32, m; sigma: (N,) float32, depth standard deviation of each point, m.

    Returns (rows, cols, 6) float64, the figures named in `FIGURES`; `noise` is the sum of the squares of `sigma`.
    Cells without points contain 0, 0, 0, inf, -inf, 0.
    """
    cells = no_figures(grid)
    _cell_statistics(np.ascontiguousarray(points), np.ascontiguousarray(sigma), grid.raster, cells)
    return cells


def extent(points: Array, grid: Grid) -> Array:
    """First row and column and end row and column of the cells with points, (4,) int64; of no cell if there are none.

    points: (N, 3) float32, m.
    """
    bounds = np.array([*grid.shape, 0, 0])
    _extent(np.ascontiguousarray(points), grid.raster, bounds)
    return bounds


@kernel
def _extent(points, raster, bounds):
    top, left, bottom, right = bounds[0], bounds[1], bounds[2], bounds[3]
    for i in range(points.shape[0]):
        row, col = cell_of(np.float64(points[i, 0]), np.float64(points[i, 1]), raster)
        if row >= 0:
            top, left, bottom, right = min(top, row), min(left, col), max(bottom, row + 1), max(right, col + 1)
    bounds[0], bounds[1], bounds[2], bounds[3] = top, left, bottom, right


def no_figures(grid: Grid) -> Array:
    """The figures of cells without points, (rows, cols, 6) float64."""
    cells = np.zeros((*grid.shape, 6))
    cells[:, :, 3], cells[:, :, 4] = np.inf, -np.inf
    return cells


@part
def cell_of(x, y, raster):
    """Row and column of a point in the window of a grid; -1, -1 outside it or beyond the range."""
    cells_per_metre, x0, y0, max_range, first_row, first_col, rows, cols = raster
    if not x * x + y * y <= max_range * max_range:
        return -1, -1
    row = int(np.floor((y - y0) * cells_per_metre)) - first_row
    col = int(np.floor((x - x0) * cells_per_metre)) - first_col
    if row < 0 or row >= rows or col < 0 or col >= cols:
        return -1, -1
    return row, col


@part
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
    for i in range(points.shape[0]):
        # numba's float() of a float32 stays a float32.
        row, col = cell_of(np.float64(points[i, 0]), np.float64(points[i, 1]), raster)
        z = np.float64(points[i, 2])
        if row >= 0 and np.isfinite(z):
            add_point(cells[row, col], z, np.float64(sigma[i]))


def cell_statistics_reference(points: Array, sigma: Array, grid: Grid) -> Array:
    """The same as `cell_statistics`, in plain numpy."""
    flat, inside = cells_of(points, grid)
    z = points[inside, 2].astype(np.float64)
    total = grid.shape[0] * grid.shape[1]
    cells = no_figures(grid).reshape(total, 6)
    for figure, weight in ((0, np.ones(len(z))), (1, z), (2, z * z), (5, sigma[inside].astype(np.float64) ** 2)):
        cells[:, figure] = np.bincount(flat, weight, minlength=total)
    np.minimum.at(cells[:, 3], flat, z)
    np.maximum.at(cells[:, 4], flat, z)
    return cells.reshape(*grid.shape, 6)


def cells_of(points: Array, grid: Grid) -> tuple[Array, Array]:
    """Flat cell index of the points on the grid, and which points those are, (N,) bool."""
    p, rows, cols = points.astype(np.float64), *grid.shape
    col, row = (
        np.floor((p[:, axis] - grid.origin[axis]) * (1.0 / grid.resolution)) - grid.first[1 - axis] for axis in (0, 1)
    )
    inside = (p[:, 0] ** 2 + p[:, 1] ** 2 <= grid.max_range**2) & np.isfinite(p[:, 2])
    inside &= (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
    return (row[inside] * cols + col[inside]).astype(np.int64), inside
