"""Points that stay in their cell: how sure it is that pixels hit a cell.

A depth error moves a point along its line of sight, perhaps into a cell that no pixel hits. Neighbouring pixels err
alike, so all points of a cell move together. Those that remain after a move of one standard deviation to either side
are sure.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array, Transform
from stages.terrain.kernels.grid import Grid, cell_of, cell_statistics_reference


def staying_points(points: Array, sigma: Array, sensor: Transform, grid: Grid, count: Array) -> Array:
    """Least number of points in each cell, as they are and with all depths one sigma smaller or larger.

    points: (N, 3) float32, m; sigma: (N,) float32, depth standard deviation, m; sensor: the camera in the points'
    frame; count: (rows, cols) float64, points in each cell as they are. Returns (rows, cols) int32.
    """
    moved, least = np.zeros((*grid.shape, 2), np.int32), np.empty(grid.shape, np.int32)
    camera = sensor.translation, sensor.rotation[:, 2].copy()
    _count(np.ascontiguousarray(points), np.ascontiguousarray(sigma), camera, grid.raster, count, moved, least)
    return least


@kernel
def _count(points, sigma, camera, raster, count, moved, least):
    eye, axis = camera
    for i in range(points.shape[0]):
        x, y, z = points[i, 0] - eye[0], points[i, 1] - eye[1], points[i, 2] - eye[2]
        per_depth = sigma[i] / (x * axis[0] + y * axis[1] + z * axis[2])
        for side in range(2):
            stretch = (2 * side - 1) * per_depth
            row, col = cell_of(points[i, 0] + stretch * x, points[i, 1] + stretch * y, raster)
            if row >= 0:
                moved[row, col, side] += 1
    for row in range(least.shape[0]):
        for col in range(least.shape[1]):
            least[row, col] = min(count[row, col], moved[row, col, 0], moved[row, col, 1])


def staying_points_reference(points: Array, sigma: Array, sensor: Transform, grid: Grid, count: Array) -> Array:
    """The same as `staying_points`, in plain numpy."""
    ray = points - sensor.translation
    step = (sigma / (ray @ sensor.rotation[:, 2]))[:, None] * ray
    moved = [cell_statistics_reference(points + move * step, sigma, grid)[:, :, 0] for move in (-1, 1)]
    return np.asarray(np.min([count, *moved], axis=0), np.int32)
