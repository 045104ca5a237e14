"""Points of a result log as PLY, binary little-endian: the cloud of a frame, the cells of a regional map in colours."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from recordings.export.mosaic import STRIP_ROWS, Mosaic
from stages.data import Array, PixelOrigin, Tiles, Transform

COLORS = [("red", "u1"), ("green", "u1"), ("blue", "u1")]
_PROPERTIES = {"<f8": "double", "<f4": "float", "|u1": "uchar"}
CELL_COLOR = np.dtype([("sigma", "f4"), ("rgb", "u1", (3,)), ("seen", "u1")])  # of one cell of a regional map
_CENTRES = [("x", "<f8"), ("y", "<f8"), ("z", "<f8")]
_POINTS = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]


def _vertex(place: list[tuple[str, str]], colored: bool, has_sigma: bool) -> np.dtype[np.void]:
    return np.dtype([*place, *(COLORS if colored else []), *([("sigma", "<f4")] if has_sigma else [])])


def write_points(path: Path, points: dict[str, Array], about: str) -> None:
    """All points of a frame; their `source` is 1 (measured), 2 (plane) or 3 (filled)."""
    place = [*_POINTS, *([("source", "u1")] if "source" in points else [])]
    dtype = _vertex(place, "colors" in points, "sigma" in points)
    vertices = np.empty(len(points["x"]), dtype)
    for name in ("x", "y", "z", "source", "sigma"):
        if name in points:
            vertices[name] = points[name]
    for channel, (name, _) in enumerate(COLORS if "colors" in points else []):
        vertices[name] = points["colors"][:, channel]
    write_ply(path, dtype, [vertices], about)


def add_colors(colors: Tiles, points: dict[str, Array], level: Transform, resolution: float) -> None:
    """Keep, for every cell, the colour of its point with the smallest sigma."""
    if "source" in points:  # only measured points give a colour
        points = {name: values[points["source"] == PixelOrigin.MEASURED] for name, values in points.items()}
    if "colors" not in points or "sigma" not in points or not len(points["x"]):
        return
    x, y, _ = level(np.column_stack([points["x"], points["y"], points["z"]])).T
    col, row = (np.floor(place / resolution).astype(np.int64) for place in (x, y))
    first_row, first_col = int(row.min()), int(col.min())
    shape = int(row.max()) - first_row + 1, int(col.max()) - first_col + 1
    cell = (row - first_row) * shape[1] + col - first_col
    order = np.lexsort((points["sigma"], cell))
    best = order[np.unique(cell[order], return_index=True)[1]]
    block = colors.read(first_row, first_col, *shape).reshape(-1)
    place = cell[best]
    better = (block["seen"][place] == 0) | (points["sigma"][best] < block["sigma"][place])
    place, best = place[better], best[better]
    block["sigma"][place], block["rgb"][place], block["seen"][place] = points["sigma"][best], points["colors"][best], 1
    changed = np.zeros(len(block), bool)
    changed[place] = True
    colors.write(first_row, first_col, block.reshape(shape), changed.reshape(shape))


def write_cells(path: Path, terrain: Mosaic, colors: Tiles, about: str) -> None:
    """One point for every known cell: its centre and elevation, its colour, and its sigma."""
    colored, has_sigma = bool(colors.tiles), "variance" in terrain.fills
    dtype = _vertex(_CENTRES, colored, has_sigma)

    def parts() -> Iterator[Array]:
        rows, cols = terrain.shape
        first_col, first_row = (round(corner / terrain.resolution) for corner in terrain.origin)
        for low in range(0, rows, STRIP_ROWS):
            count = min(STRIP_ROWS, rows - low)
            elevation = terrain.block("elevation", low, 0, count, cols)
            known = np.isfinite(elevation)
            row, col = np.nonzero(known)
            vertices = np.empty(len(row), dtype)
            vertices["x"] = (first_col + col + 0.5) * terrain.resolution
            vertices["y"] = (first_row + low + row + 0.5) * terrain.resolution
            vertices["z"] = elevation[known]
            if has_sigma:
                vertices["sigma"] = np.sqrt(terrain.block("variance", low, 0, count, cols)[known])
            if colored:
                cells = colors.read(first_row + low - STRIP_ROWS, first_col, count + 2 * STRIP_ROWS, cols)
                rgb = _nearest_colors(cells["rgb"], cells["seen"] > 0)[STRIP_ROWS : STRIP_ROWS + count][known]
                for place, (name, _) in enumerate(COLORS):
                    vertices[name] = rgb[:, place]
            yield vertices

    write_ply(path, dtype, parts(), about)


def _nearest_colors(rgb: Array, seen: Array) -> Array:
    """The colours (rows, cols, 3) with those of the nearest cell that a coloured point lies in; gray without any."""
    from scipy.ndimage import distance_transform_edt  # takes long to import

    if not seen.any():
        return np.full_like(rgb, 127)
    row, col = distance_transform_edt(~seen, return_distances=False, return_indices=True)
    return np.asarray(rgb[row, col])


def write_ply(path: Path, dtype: np.dtype[np.void], parts: Iterable[Array], comment: str) -> None:
    """Write vertices.

    dtype: one property per field; parts: structured arrays (n,) of it; comment: one line of ASCII. The header contains
    the number of points, so it is filled in at the end.
    """
    properties = "".join(f"property {_PROPERTIES[dtype[name].str]} {name}\n" for name in dtype.names or ())
    begin = f"ply\nformat binary_little_endian 1.0\ncomment {comment}\nelement vertex ".encode("ascii", "replace")
    count = 0
    with path.open("wb") as file:
        file.write(begin + f"{count:>10d}\n{properties}end_header\n".encode())
        for part in parts:
            file.write(part.tobytes())
            count += len(part)
        file.seek(len(begin))
        file.write(f"{count:>10d}".encode())
