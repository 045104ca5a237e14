"""Which empty cells of a grid were hidden from the camera, as against never looked at, and below what they lie.

Up a column of the image the ground recedes. Where two neighbouring points of a column lie cells apart, the line of
sight has jumped over what lies between: it is behind the nearer one, or was not matched. So is what lies beyond the
last point of a column, up to the end of the region. Empty cells that no such line crosses were never in view. What is
hidden lies below the line that jumps over it, or it would be seen.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array


def lowest_sight(
    points: Array,
    pixel: Array,
    width: int,
    camera: tuple[float, float, float],
    resolution: float,
    origin: tuple[float, float],
    size: int,
    region: float,
) -> Array:
    """The height, m, of the lowest line of sight that jumps over a cell, (size, size) float64, NaN where none does; be
    there points of other lines in the cell or not.

    points: (N, 3) float32 in the level frame, m; pixel: (N,) int32, ascending, index into an image of `width` columns;
    camera: where it is, m; resolution, origin, size: the grid; region: m, the largest range from (0, 0).
    """
    lowest = np.full((size, size), np.nan)
    x, y, z = camera
    _lowest_sight(
        np.ascontiguousarray(points), np.ascontiguousarray(pixel), int(width), float(x), float(y), float(z),
        1.0 / resolution, float(origin[0]), float(origin[1]), float(region), lowest,
    )  # fmt: skip
    return lowest


@kernel
def _mark(lowest, x, y, z, dx, dy, dz, length, cells_per_metre, x0, y0, region):
    """Lower the cells under the line from (x, y, z), in direction (dx, dy, dz), (dx, dy) a unit vector, to it; sampled
    four times a cell, where it is within the region, be it ever so long."""
    size = lowest.shape[0]
    middle, aside, reach = -(x * dx + y * dy), x * dy - y * dx, region + 1.0 / cells_per_metre
    if not abs(aside) <= reach:
        return
    half = np.sqrt(reach * reach - aside * aside)
    first = int(max(middle - half, 0.0) * cells_per_metre * 4.0)
    last = int(min(middle + half, length) * cells_per_metre * 4.0)
    for k in range(max(first, 1), last + 1):
        way = k / (4.0 * cells_per_metre)
        px, py = x + dx * way, y + dy * way
        col, row = int(np.floor((px - x0) * cells_per_metre)), int(np.floor((py - y0) * cells_per_metre))
        if 0 <= row < size and 0 <= col < size and px * px + py * py <= region * region:
            height = z + dz * way
            if not lowest[row, col] <= height:
                lowest[row, col] = height


@kernel
def _lowest_sight(points, pixel, width, camera_x, camera_y, camera_z, cells_per_metre, x0, y0, region, lowest):
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
            dx, dy, dz = dx / length, dy / length, dz / length
            _mark(lowest, x, y, z, dx, dy, dz, length, cells_per_metre, x0, y0, region)
    for column in range(width):
        end = last[column]
        if end < 0:
            continue
        x, y, z = np.float64(points[end, 0]), np.float64(points[end, 1]), np.float64(points[end, 2])
        dx, dy, dz = x - camera_x, y - camera_y, z - camera_z
        length = np.sqrt(dx * dx + dy * dy)
        if length > 0.0 and x * x + y * y < region * region:
            dx, dy, dz = dx / length, dy / length, dz / length
            _mark(lowest, x, y, z, dx, dy, dz, 2.0 * region, cells_per_metre, x0, y0, region)


def lowest_sight_reference(
    points: Array,
    pixel: Array,
    width: int,
    camera: tuple[float, float, float],
    resolution: float,
    origin: tuple[float, float],
    size: int,
    region: float,
) -> Array:
    """The same as `lowest_sight`, one image column at a time, in plain numpy."""
    lowest = np.full((size, size), np.inf)
    for column in np.unique(pixel % width):
        line = points[pixel % width == column][::-1].astype(np.float64)
        for start, end in zip(line, [*line[1:], None], strict=True):
            way = start - camera if end is None else end - start
            length = np.hypot(*way[:2])
            reach = 2 * region if end is None else length
            if length == 0 or (start[:2] @ start[:2] >= region**2 if end is None else length <= resolution):
                continue
            steps = np.arange(1, int(reach / resolution * 4) + 1) * resolution / 4
            places = start + way / length * steps[:, None]
            col, row = np.floor((places[:, :2] - origin) / resolution).astype(int).T
            on_grid = (np.minimum(col, row) >= 0) & (np.maximum(col, row) < size)
            on_grid &= (places[:, :2] ** 2).sum(axis=1) <= region**2
            np.minimum.at(lowest, (row[on_grid], col[on_grid]), places[on_grid, 2])
    return np.where(np.isfinite(lowest), lowest, np.nan)
