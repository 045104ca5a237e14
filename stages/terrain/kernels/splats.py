"""Splats: copies of points along their lines of sight, as far as their depth is uncertain.

Far from the camera the depth of a pixel is uncertain by a cell or more, so the cell that receives the point is chance.
Copies on both sides of the point reach all candidate cells.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array, Transform
from stages.terrain.kernels.grid import Grid, add_point, cell_of, cell_statistics_reference, no_figures

OFFSETS = np.array([-1.0, -0.5, 0.5, 1.0])  # of the copies, as shares of the reach


def splat_statistics(
    points: Array, sigma: Array, sensor: Transform, reach: tuple[float, float, float], grid: Grid, empty: Array
) -> Array:
    """Figures of four copies of each point whose depth is uncertain, in the cells that are `empty`.

    points: (N, 3) float32, m; sigma: (N,) float32, depth standard deviation, m; sensor: the camera in the points'
    frame; reach: of the copies to either side, in standard deviations; the least that makes a copy, m of depth; the
    largest, m; empty: (rows, cols) bool. Returns (rows, cols, 6) float64, as `cell_statistics` does.
    """
    figures = no_figures(grid)
    camera = sensor.translation, sensor.rotation[:, 2].copy()
    sigmas, least, most = reach
    reach = float(sigmas), float(np.float32(least)), float(most)
    points, sigma = np.ascontiguousarray(points), np.ascontiguousarray(sigma)
    _splat(points, sigma, camera, reach, OFFSETS, grid.raster, np.ascontiguousarray(empty), figures)
    return figures


@kernel
def _splat(points, sigma, camera, reach, offsets, raster, empty, figures):
    eye, axis = camera
    sigmas, least, most = reach
    factor = np.float32(sigmas)
    for i in range(points.shape[0]):
        if not sigma[i] * factor >= least:
            continue
        x, y, z = points[i, 0] - eye[0], points[i, 1] - eye[1], points[i, 2] - eye[2]
        per_depth = min(sigmas * sigma[i], most) / (x * axis[0] + y * axis[1] + z * axis[2])
        for n in range(offsets.size):
            stretch = offsets[n] * per_depth
            row, col = cell_of(points[i, 0] + stretch * x, points[i, 1] + stretch * y, raster)
            if row >= 0 and empty[row, col]:
                add_point(figures[row, col], points[i, 2] + stretch * z, np.float64(sigma[i]))


def splat_statistics_reference(
    points: Array, sigma: Array, sensor: Transform, reach: tuple[float, float, float], grid: Grid, empty: Array
) -> Array:
    """The same as `splat_statistics`, in plain numpy."""
    sigmas, least, most = reach
    far = sigma * np.float32(sigmas) >= np.float32(least)
    points, sigma = points[far].astype(np.float64), sigma[far]
    ray = points - sensor.translation
    stretch = (np.minimum(sigmas * sigma, most) / (ray @ sensor.rotation[:, 2]))[:, None] * OFFSETS
    copies = points[:, None] + stretch[:, :, None] * ray[:, None]
    figures = cell_statistics_reference(copies.reshape(-1, 3), sigma.repeat(len(OFFSETS)), grid)
    return np.where(empty[:, :, None], figures, no_figures(grid))
