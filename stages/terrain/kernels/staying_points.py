"""Points that stay in their cell: how sure it is that pixels hit a cell.

A depth error moves a point along its line of sight, perhaps into a cell that no pixel hits. Neighbouring pixels err
alike, so all points of a cell move together. Those that remain after a move of one standard deviation to either side
are sure.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array, Transform
from stages.terrain.kernels.grid import Grid


def staying_points(points: Array, sigma: Array, sensor: Transform, grid: Grid) -> Array:
    """Least number of points in each cell, as they are and with all depths one sigma smaller or larger.

    points: (N, 3) float32, m; sigma: (N,) float32, depth standard deviation, m; sensor: the camera in the points'
    frame. Returns (size, size) int32.
    """
    resolution, (x0, y0), size, max_range = grid
    counts = np.zeros((size, size, 3), np.int32)
    camera = sensor.translation, sensor.rotation[:, 2].copy()
    raster = 1.0 / resolution, float(x0), float(y0), float(max_range)
    _count(np.ascontiguousarray(points), np.ascontiguousarray(sigma), camera, raster, counts)
    return np.asarray(counts.min(axis=2))


@kernel
def _count(points, sigma, camera, raster, counts):
    eye, axis = camera
    cells_per_metre, x0, y0, max_range = raster
    size = counts.shape[0]
    for i in range(points.shape[0]):
        x, y, z = points[i, 0] - eye[0], points[i, 1] - eye[1], points[i, 2] - eye[2]
        per_depth = sigma[i] / (x * axis[0] + y * axis[1] + z * axis[2])
        for move in range(3):
            px = points[i, 0] + (move - 1) * per_depth * x
            py = points[i, 1] + (move - 1) * per_depth * y
            if not px * px + py * py <= max_range * max_range:
                continue
            col, row = int(np.floor((px - x0) * cells_per_metre)), int(np.floor((py - y0) * cells_per_metre))
            if 0 <= row < size and 0 <= col < size:
                counts[row, col, move] += 1


def staying_points_reference(points: Array, sigma: Array, sensor: Transform, grid: Grid) -> Array:
    """The same as `staying_points`, in plain numpy."""
    resolution, origin, size, max_range = grid
    ray = points - sensor.translation
    step = (sigma / (ray @ sensor.rotation[:, 2]))[:, None] * ray
    counts = []
    for move in (-1, 0, 1):
        place = (points + move * step)[:, :2]
        col, row = np.floor((place - origin) * (1.0 / resolution)).astype(int).T
        on_grid = (place**2).sum(axis=1) <= max_range**2
        on_grid &= (np.minimum(col, row) >= 0) & (np.maximum(col, row) < size)
        cells = row[on_grid] * size + col[on_grid]
        counts.append(np.bincount(cells, minlength=size * size).reshape(size, size))
    return np.asarray(np.min(counts, axis=0), np.int32)
