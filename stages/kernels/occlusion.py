"""Which empty cells of a grid were hidden from the camera, as against never looked at.

Up a column of the image the ground recedes. Where two neighbouring points of a column lie cells apart, the line of
sight has jumped over what lies between: it is behind the nearer one, or was not matched. So is what lies beyond the
last point of a column, up to the end of the region. Empty cells that no such line crosses were never in view.
"""

from __future__ import annotations

import numba
import numpy as np

from stages.data import Array


def hidden_cells(
    points: Array,
    pixel: Array,
    width: int,
    camera: tuple[float, float],
    resolution: float,
    origin: tuple[float, float],
    size: int,
    region: float,
) -> Array:
    """The cells that lines of sight jump over, (size, size) bool, be there points of other lines in them or not.

    points: (N, 3) float32 in the level frame, m; pixel: (N,) int32, ascending, index into an image of `width` columns;
    camera: its (x, y), m; resolution, origin, size: the grid; region: m, the largest range from (0, 0).
    """
    hidden = np.zeros((size, size), np.bool_)
    _hidden_cells(
        np.ascontiguousarray(points), np.ascontiguousarray(pixel), int(width), float(camera[0]), float(camera[1]),
        1.0 / resolution, float(origin[0]), float(origin[1]), float(region), hidden,
    )  # fmt: skip
    return hidden


@numba.njit(nogil=True, cache=True)
def _mark(hidden, x, y, dx, dy, length, cells_per_metre, x0, y0, region):  # type: ignore[no-untyped-def]
    """Mark the cells under the line from (x, y), in unit direction (dx, dy), sampled four times a cell."""
    size = hidden.shape[0]
    for k in range(1, int(length * cells_per_metre * 4.0) + 1):
        px, py = x + dx * k / (4.0 * cells_per_metre), y + dy * k / (4.0 * cells_per_metre)
        col, row = int(np.floor((px - x0) * cells_per_metre)), int(np.floor((py - y0) * cells_per_metre))
        if 0 <= row < size and 0 <= col < size and px * px + py * py <= region * region:
            hidden[row, col] = True


@numba.njit(nogil=True, cache=True)
def _hidden_cells(points, pixel, width, camera_x, camera_y, cells_per_metre, x0, y0, region, hidden):  # type: ignore[no-untyped-def]
    last = np.full(width, -1, np.int64)
    for i in range(points.shape[0] - 1, -1, -1):
        column = pixel[i] % width
        nearer = last[column]
        last[column] = i
        if nearer < 0:
            continue
        x, y = np.float64(points[nearer, 0]), np.float64(points[nearer, 1])
        dx, dy = points[i, 0] - x, points[i, 1] - y
        length = np.sqrt(dx * dx + dy * dy)
        if length * cells_per_metre > 1.0:
            _mark(hidden, x, y, dx / length, dy / length, length, cells_per_metre, x0, y0, region)
    for column in range(width):
        if last[column] < 0:
            continue
        x, y = np.float64(points[last[column], 0]), np.float64(points[last[column], 1])
        dx, dy = x - camera_x, y - camera_y
        length = np.sqrt(dx * dx + dy * dy)
        if length > 0.0 and x * x + y * y < region * region:
            _mark(hidden, x, y, dx / length, dy / length, 2.0 * region, cells_per_metre, x0, y0, region)


def hidden_cells_reference(
    points: Array,
    pixel: Array,
    width: int,
    camera: tuple[float, float],
    resolution: float,
    origin: tuple[float, float],
    size: int,
    region: float,
) -> Array:
    """The same as `hidden_cells`, one image column at a time, in plain numpy."""
    hidden = np.zeros((size, size), bool)
    for column in np.unique(pixel % width):
        line = points[pixel % width == column][::-1, :2].astype(np.float64)
        for start, end in zip(line, [*line[1:], None], strict=True):
            way = start - camera if end is None else end - start
            length = np.hypot(*way)
            reach = 2 * region if end is None else length
            if length == 0 or (start @ start >= region**2 if end is None else length <= resolution):
                continue
            steps = np.arange(1, int(reach / resolution * 4) + 1) * resolution / 4
            places = start + way / length * steps[:, None]
            col, row = np.floor((places - origin) / resolution).astype(int).T
            on_grid = (np.minimum(col, row) >= 0) & (np.maximum(col, row) < size)
            on_grid &= (places**2).sum(axis=1) <= region**2
            hidden[row[on_grid], col[on_grid]] = True
    return hidden
