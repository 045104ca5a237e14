"""Occluded cells: which empty cells were hidden from the camera, and the line of sight below which they lie.

Up a column of the image the ground recedes. If two neighbouring points of a column are more than a cell apart, the
cells between them are occluded or were not matched. So are the cells behind the last point of a column, up to the
maximum range. Empty cells that no such line crosses were never in view.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel, part
from stages.data import Array
from stages.terrain.kernels.grid import Grid, cell_of, cells_of


def occlusion_ceiling(points: Array, pixel: Array, width: int, camera: Array, grid: Grid) -> Array:
    """Height, m, of the lowest line of sight that passes over each cell, (rows, cols) float64, NaN without one.

    points: (N, 3) float32 in the level frame, m; pixel: (N,) int32, ascending, index into an image of `width` columns;
    camera: (3,) position, m. Cells with points of other lines get a height too.
    """
    ceiling = np.full(grid.shape, np.nan)
    eye = (float(camera[0]), float(camera[1]), float(camera[2]))
    points, pixel = np.ascontiguousarray(points), np.ascontiguousarray(pixel)
    _occlusion_ceiling(points, pixel, int(width), eye, grid.raster, ceiling)
    return ceiling


@part
def _lower(ceiling, x, y, z, dx, dy, dz, length, raster):
    """Lower the ceiling to a line from (x, y, z) along (dx, dy, dz), where (dx, dy) is a unit vector.

    The line is sampled four times a cell, only within the range, however long it is."""
    cells_per_metre, max_range = raster[0], raster[3]
    middle, aside, reach = -(x * dx + y * dy), x * dy - y * dx, max_range + 1.0 / cells_per_metre
    if not abs(aside) <= reach:
        return
    half = np.sqrt(reach * reach - aside * aside)
    first = int(max(middle - half, 0.0) * cells_per_metre * 4.0)
    last = int(min(middle + half, length) * cells_per_metre * 4.0)
    for k in range(max(first, 1), last + 1):
        way = k / (4.0 * cells_per_metre)
        row, col = cell_of(x + dx * way, y + dy * way, raster)
        height = z + dz * way
        if row >= 0:  # without a branch on the height, which nothing predicts
            lowest = ceiling[row, col]
            ceiling[row, col] = lowest if lowest <= height else height


@kernel
def _occlusion_ceiling(points, pixel, width, eye, raster, ceiling):
    cells_per_metre, max_range = raster[0], raster[3]
    last = np.full(width, -1, np.int64)
    for i in range(points.shape[0] - 1, -1, -1):
        column = pixel[i] % width
        nearer = last[column]
        last[column] = i
        if nearer < 0:
            continue
        x, y, z = np.float64(points[nearer, 0]), np.float64(points[nearer, 1]), np.float64(points[nearer, 2])
        dx, dy, dz = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
        length = np.sqrt(dx * dx + dy * dy)
        if length * cells_per_metre > 1.0:
            _lower(ceiling, x, y, z, dx / length, dy / length, dz / length, length, raster)
    for column in range(width):
        end = last[column]
        if end < 0:
            continue
        x, y, z = np.float64(points[end, 0]), np.float64(points[end, 1]), np.float64(points[end, 2])
        dx, dy, dz = x - eye[0], y - eye[1], z - eye[2]
        length = np.sqrt(dx * dx + dy * dy)
        if length > 0.0 and x * x + y * y < max_range * max_range:
            _lower(ceiling, x, y, z, dx / length, dy / length, dz / length, 2.0 * max_range, raster)


def occlusion_ceiling_reference(points: Array, pixel: Array, width: int, camera: Array, grid: Grid) -> Array:
    """The same as `occlusion_ceiling`, one image column at a time, in plain numpy."""
    resolution, max_range, ceiling = grid.resolution, grid.max_range, np.full(grid.shape, np.inf)
    for column in np.unique(pixel % width):
        line = points[pixel % width == column][::-1].astype(np.float64)
        for start, end in zip(line, [*line[1:], None], strict=True):
            way = start - camera if end is None else end - start
            length = np.hypot(*way[:2])
            reach = 2 * max_range if end is None else length
            if length == 0 or (start[:2] @ start[:2] >= max_range**2 if end is None else length <= resolution):
                continue
            steps = np.arange(1, int(reach / resolution * 4) + 1) * resolution / 4
            samples = start + way / length * steps[:, None]
            cells, on_grid = cells_of(samples, grid)
            np.minimum.at(ceiling.reshape(-1), cells, samples[on_grid, 2])
    return np.where(np.isfinite(ceiling), ceiling, np.nan)
