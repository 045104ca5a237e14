"""Cell statistics of points over a regular grid, in one pass (paper section 4, "voxelisation").

The six running figures of a cell lie next to each other, so a point touches one cache line; sums are float64, so that
neither the order of magnitude nor the number of points costs accuracy. Percentiles need the points of a cell in order:
one sort of all points by cell and height, for those who ask.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array

FIGURES = ("count", "sum", "sum_of_squares", "minimum", "maximum", "noise")


def cell_statistics(
    points: Array, sigma: Array, resolution: float, origin: tuple[float, float], size: int, region: float
) -> Array:
    """Figures of the heights that fall in each cell of a square grid.

    points: (N, 3) float32, m; sigma: (N,) float32, depth standard deviation of each point, m; resolution: m;
    origin: (x, y) of the corner of cell [0, 0]; size: rows and columns; region: m, points at a larger horizontal range
    from (0, 0) are left out.

    Returns (size, size, 6) float64, the figures named in `FIGURES`; `noise` is the sum of the squares of `sigma`.
    Cells without points hold 0, 0, 0, inf, -inf, 0.
    """
    return _cell_statistics(  # type: ignore[no-any-return]
        np.ascontiguousarray(points),
        np.ascontiguousarray(sigma),
        1.0 / resolution,
        float(origin[0]),
        float(origin[1]),
        int(size),
        float(region),
    )


@kernel
def _cell_statistics(points, sigma, cells_per_metre, x0, y0, size, region):
    cells = np.zeros((size, size, 6), np.float64)
    cells[:, :, 3] = np.inf
    cells[:, :, 4] = -np.inf
    for i in range(points.shape[0]):
        # numba's float() of a float32 stays a float32.
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        if not (x * x + y * y <= region * region and np.isfinite(z)):
            continue
        col = int(np.floor((x - x0) * cells_per_metre))
        row = int(np.floor((y - y0) * cells_per_metre))
        if row < 0 or row >= size or col < 0 or col >= size:
            continue
        error = np.float64(sigma[i])
        cell = cells[row, col]
        cell[0] += 1.0
        cell[1] += z
        cell[2] += z * z
        cell[3] = min(cell[3], z)
        cell[4] = max(cell[4], z)
        cell[5] += error * error
    return cells


def cell_statistics_reference(
    points: Array, sigma: Array, resolution: float, origin: tuple[float, float], size: int, region: float
) -> Array:
    """The same as `cell_statistics`, in plain numpy."""
    flat, inside = _cells_of(points, resolution, origin, size, region)
    z = points[inside, 2].astype(np.float64)
    cells = np.zeros((size * size, 6))
    cells[:, 3], cells[:, 4] = np.inf, -np.inf
    for figure, weight in ((0, np.ones(len(z))), (1, z), (2, z * z), (5, sigma[inside].astype(np.float64) ** 2)):
        cells[:, figure] = np.bincount(flat, weight, minlength=size * size)
    np.minimum.at(cells[:, 3], flat, z)
    np.maximum.at(cells[:, 4], flat, z)
    return cells.reshape(size, size, 6)


def cell_percentile(
    points: Array, percentile: float, resolution: float, origin: tuple[float, float], size: int, region: float
) -> Array:
    """The height below which `percentile` percent of each cell's points lie, (size, size) float32, NaN without points.

    Arguments as of `cell_statistics`; between two points it is interpolated, as numpy does.
    """
    flat, inside = _cells_of(points, resolution, origin, size, region)
    z = points[inside, 2]
    order = np.lexsort((z, flat))
    flat, z = flat[order], z[order].astype(np.float64)
    cell, start, count = np.unique(flat, return_index=True, return_counts=True)
    place = percentile / 100 * (count - 1)
    below = np.floor(place).astype(np.int64)
    low, high = z[start + below], z[start + np.minimum(below + 1, count - 1)]
    heights = np.full(size * size, np.nan, np.float32)
    heights[cell] = low + (place - below) * (high - low)
    return heights.reshape(size, size)


def _cells_of(
    points: Array, resolution: float, origin: tuple[float, float], size: int, region: float
) -> tuple[Array, Array]:
    """Flat cell index of the points on the grid, and which points those are, (N,) bool."""
    p = points.astype(np.float64)
    col = np.floor((p[:, 0] - origin[0]) * (1.0 / resolution))
    row = np.floor((p[:, 1] - origin[1]) * (1.0 / resolution))
    inside = (p[:, 0] ** 2 + p[:, 1] ** 2 <= region**2) & np.isfinite(p[:, 2])
    inside &= (row >= 0) & (row < size) & (col >= 0) & (col < size)
    return (row[inside] * size + col[inside]).astype(np.int64), inside
