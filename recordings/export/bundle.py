"""A result log as files: the regional map whole, or every frame's own maps and points.

The log is read as any consumer would, once, frame by frame; the regional map is put together of the windows that the
frames gave, in memory that grows with the ground seen and not with the rectangle about it.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import chain, count, groupby
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from recordings.atomic_write import written
from recordings.errors import LogError, said
from recordings.export.geotiff import write_geotiff
from recordings.export.map_server import write_pgm, write_yaml
from recordings.export.mosaic import RIM, STRIP, Mosaic
from recordings.export.ply import COLOURS, write_ply
from recordings.mcap.file import iter_decoded
from recordings.ros2 import from_msg as ros2
from recordings.ros2.from_msg import transform_of
from recordings.scoring.result_log import without_results
from recordings.sinks.colormaps import hillshade
from stages.data import LEVEL_FRAME, Array, Cell, ElevationMap, NavigationMap, PixelOrigin, Tiles, Transform

REGION = ("/nav/regional_map", "/nav/regional_navigation_map")
FRAME = ("/nav/elevation_map", "/nav/navigation_map")
POINTS = "/nav/points"
# As in other hillshades: the sun in the north-west, 45 degrees high, for a picture whose upper edge is north.
_NORTH_WEST = np.array([-0.5, 0.5, np.sqrt(0.5)])
_COLOUR = np.dtype([("sigma", "f4"), ("rgb", "u1", (3,)), ("seen", "u1")])
_LONGEST = 100  # bytes of the name of a file that a log chooses
_CENTRES = [("x", "<f8"), ("y", "<f8"), ("z", "<f8")]
_POINTS = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]


def export(result: Path, out: Path, frames: bool = False, lost: Counter[str] | None = None) -> list[Path]:
    """Write the regional map of a result log into the folder `out`, or with `frames` the maps of every frame into a
    folder each; returns the files.

    With `lost`, what is left of a damaged log is exported, and why messages were lost is counted there. Raises LogError
    where the log cannot be read, or holds no such map.
    """
    return _export_frames(result, out, lost) if frames else _export_region(result, out, lost)


def _messages(result: Path, lost: Counter[str] | None, *topics: str) -> Iterator[tuple[int, dict[str, Any]]]:
    """(stamp, topic -> message) of every frame; under "level" where the frame `level` lies in another."""
    wanted = iter_decoded(result, [*topics, "/tf"], lost)
    for stamp, group in groupby(wanted, key=lambda item: item[1]):
        frame: dict[str, Any] = {}
        for topic, _, message in group:
            if topic != "/tf":
                frame[topic] = message
                continue
            for item in message.transforms:
                if item.child_frame_id == LEVEL_FRAME:
                    frame["level"] = transform_of(item)
        yield stamp, frame


@dataclass(eq=False)
class _RegionExport:
    """The regional map in one frame of reference, as far as it has been read."""

    terrain: Mosaic
    navigation: Mosaic | None = None
    colours: Tiles = field(default_factory=lambda: Tiles(_COLOUR))
    last: int = 0

    def write(self, out: Path) -> list[Path]:
        about = f"roverflow: local frame '{self.terrain.frame_id}', metres, z up; up to {self.last} ns"
        files = _write_maps(out, self.terrain, self.navigation, about)
        return [*files, _write(out / "points.ply", _write_cells, self.terrain, self.colours, about)]


def _export_region(result: Path, out: Path, lost: Counter[str] | None) -> list[Path]:
    """The regional map in `out`; where it began anew in further frames of reference, a folder for each in `out`."""
    regions: dict[str, _RegionExport] = {}
    for stamp, frame in _messages(result, lost, *REGION, POINTS):
        if REGION[0] in frame:
            given = _read(ros2.read_grid_map, frame[REGION[0]], result)
            region = regions.setdefault(given.frame_id, _RegionExport(_terrain_mosaic(given, RIM)))
            region.last = stamp
            _lay_terrain(region.terrain, given)
            if POINTS in frame and "level" in frame:
                points = _read(_fields_of, frame[POINTS], result)
                _colour(region.colours, points, frame["level"], given.resolution)
            if REGION[1] in frame:
                cells = _read(ros2.read_occupancy_grid, frame[REGION[1]], result)
                region.navigation = region.navigation or _navigation_mosaic(cells, RIM)
                _lay_navigation(region.navigation, cells)
    if not regions:
        _check_damage(result, lost)
        raise without_results(
            result, REGION[:1], instead=(*FRAME, POINTS), remedy="add --frames to export the maps of every frame"
        )
    known = {name: region for name, region in regions.items() if region.terrain.close()}
    if not known:
        raise LogError(f"no cell of {REGION[0]} in {result} is known: there is nothing to export")
    if len(known) == 1:
        return next(iter(known.values())).write(out)
    folders = file_names(known)
    return [file for name, region in known.items() for file in region.write(out / folders[name])]


def _export_frames(result: Path, out: Path, lost: Counter[str] | None) -> list[Path]:
    files: list[Path] = []
    number = 0
    for stamp, frame in _messages(result, lost, *FRAME, POINTS):
        folder, written_before = out / f"frame-{number:04d}-{stamp}", len(files)
        about = f"roverflow: local frame '{LEVEL_FRAME}', metres, z up; at {stamp} ns"
        given = frame.get(FRAME[0])
        terrain = None if given is None else _read(ros2.read_grid_map, given, result)
        if terrain is not None:
            mosaic = _terrain_mosaic(terrain, 0.0)
            _lay_terrain(mosaic, terrain)
            cells = None
            if FRAME[1] in frame:
                navigation = _read(ros2.read_occupancy_grid, frame[FRAME[1]], result)
                cells = _navigation_mosaic(navigation, 0.0)
                _lay_navigation(cells, navigation)
            if mosaic.close():
                files += _write_maps(folder, mosaic, cells, about)
        if POINTS in frame:
            points = _read(_fields_of, frame[POINTS], result)
            files.append(_write(folder / "points.ply", _write_points, points, about))
        number += len(files) > written_before
    if not files:
        _check_damage(result, lost)
        raise without_results(result, (*FRAME, POINTS))
    return files


def file_names(names: Iterable[str]) -> dict[str, str]:
    """For each of the names, which a log may have chosen badly, that of a file: in its folder, and of no other."""
    chosen: dict[str, str] = {}
    for name in names:
        short = re.sub(r"[^\w.-]", "-", name).encode()[:_LONGEST].decode(errors="ignore")
        plain = short.lstrip(".") or "unnamed"
        others = {other.casefold() for other in chosen.values()}
        numbered = (f"{plain}{number}" for number in chain([""], (f"-{number}" for number in count(2))))
        chosen[name] = next(other for other in numbered if other.casefold() not in others)
    return chosen


def _check_damage(result: Path, lost: Counter[str] | None) -> None:
    """Raise LogError if it is damage that left nothing to export."""
    for why in lost or ():
        raise LogError(f"{result}: {why}; nothing that is left of it can be exported, run the traverse again")


def _fields_of(cloud: Any) -> dict[str, Array]:
    """The fields of a PointCloud2 that says where its points are. Raises ValueError for another."""
    fields = ros2.read_point_cloud(cloud)
    if lacking := {"x", "y", "z"} - fields.keys():
        raise ValueError(f"it lacks {', '.join(sorted(lacking))}")
    return fields


def _read(reader: Callable[[Any], Any], message: Any, result: Path) -> Any:
    try:
        return reader(message)
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        raise LogError(f"{result}: a {message.__msgtype__} in it is not one: {said(error)}") from error


def _terrain_mosaic(terrain: ElevationMap, rim: float) -> Mosaic:
    return Mosaic(terrain.resolution, terrain.frame_id, dict.fromkeys(terrain.layers, np.float32(np.nan)), rim)


def _lay_terrain(mosaic: Mosaic, terrain: ElevationMap) -> None:
    known = np.isfinite(terrain.layers["elevation"])
    mosaic.lay(terrain.layers, known, terrain.resolution, terrain.origin, terrain.frame_id)


def _navigation_mosaic(navigation: NavigationMap, rim: float) -> Mosaic:
    return Mosaic(navigation.resolution, navigation.frame_id, {"cells": np.int8(Cell.UNKNOWN)}, rim)


def _lay_navigation(mosaic: Mosaic, navigation: NavigationMap) -> None:
    known = navigation.cells != Cell.UNKNOWN
    mosaic.lay({"cells": navigation.cells}, known, navigation.resolution, navigation.origin, navigation.frame_id)


def _write(path: Path, write: Callable[..., Any], *arguments: Any) -> Path:
    """Write a file that is whole or not there, its folder made where it is missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with written(path) as temporary:
        write(temporary, *arguments)
    return path


def _write_maps(folder: Path, terrain: Mosaic, navigation: Mosaic | None, about: str) -> list[Path]:
    """A GeoTIFF of each layer, the hillshade with its world file, and the navigation map with its YAML."""
    names = file_names(terrain.fills)
    files = [_write(folder / f"{names[layer]}.tif", write_geotiff, terrain, layer, about) for layer in terrain.fills]
    files.append(_write(folder / "hillshade.png", _write_hillshade, terrain))
    files.append(_write(folder / "hillshade.pgw", _write_world_file, terrain))
    if navigation is not None:
        navigation.close(like=terrain)
        files.append(_write(folder / "navigation_map.pgm", write_pgm, navigation, "cells"))
        files.append(_write(folder / "navigation_map.yaml", write_yaml, "navigation_map.pgm", navigation))
    return files


def _write_hillshade(path: Path, terrain: Mosaic) -> None:
    """1 to 255, bright where the sun falls in steeply, and 0 where nothing is known."""
    shades = np.zeros(terrain.shape, np.uint8)
    rows = terrain.shape[0]
    for low in range(0, rows, STRIP):
        high = min(rows, low + STRIP)
        # With a row on either side, so that slopes are those of the whole map.
        block = terrain.block("elevation", low - 1, 0, high - low + 2, terrain.shape[1])
        lit = np.where(np.isfinite(block), 1 + 254 * hillshade(block, terrain.resolution, _NORTH_WEST), 0)
        shades[rows - high : rows - low] = np.rint(lit[1:-1]).astype(np.uint8)[::-1]
    _, blob = cv2.imencode(".png", shades)
    path.write_bytes(blob.tobytes())


def _write_world_file(path: Path, terrain: Mosaic) -> None:
    """Six lines: cell sizes, and the centre of the upper left cell."""
    (x, y), step, rows = terrain.origin, terrain.resolution, terrain.shape[0]
    lines = (step, 0.0, 0.0, -step, x + step / 2, y + (rows - 0.5) * step)
    path.write_text("".join(f"{value:.9f}\n" for value in lines))


def _vertex(place: list[tuple[str, str]], coloured: bool, sure: bool) -> np.dtype[np.void]:
    return np.dtype([*place, *(COLOURS if coloured else []), *([("sigma", "<f4")] if sure else [])])


def _write_points(path: Path, points: dict[str, Array], about: str) -> None:
    """All points of a frame; `source` tells which are measured (1), of a plane (2) and filled (3)."""
    place = [*_POINTS, *([("source", "u1")] if "source" in points else [])]
    dtype = _vertex(place, "colors" in points, "sigma" in points)
    vertices = np.empty(len(points["x"]), dtype)
    for name in ("x", "y", "z", "source", "sigma"):
        if name in points:
            vertices[name] = points[name]
    for channel, (name, _) in enumerate(COLOURS if "colors" in points else []):
        vertices[name] = points["colors"][:, channel]
    write_ply(path, dtype, [vertices], about)


def _colour(colours: Tiles, points: dict[str, Array], level: Transform, resolution: float) -> None:
    """Keep, for every cell, the colour of the point in it whose depth is known best."""
    if "source" in points:  # a guess colours nothing
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
    block = colours.read(first_row, first_col, *shape).reshape(-1)
    place = cell[best]
    better = (block["seen"][place] == 0) | (points["sigma"][best] < block["sigma"][place])
    place, best = place[better], best[better]
    block["sigma"][place], block["rgb"][place], block["seen"][place] = points["sigma"][best], points["colors"][best], 1
    changed = np.zeros(len(block), bool)
    changed[place] = True
    colours.write(first_row, first_col, block.reshape(shape), changed.reshape(shape))


def _write_cells(path: Path, terrain: Mosaic, colours: Tiles, about: str) -> None:
    """One point for every known cell: its centre and elevation, the surest colour seen in it, and its sigma."""
    coloured, sure = bool(colours.tiles), "variance" in terrain.fills
    dtype = _vertex(_CENTRES, coloured, sure)

    def parts() -> Iterator[Array]:
        rows, cols = terrain.shape
        first_col, first_row = (round(corner / terrain.resolution) for corner in terrain.origin)
        for low in range(0, rows, STRIP):
            count = min(STRIP, rows - low)
            elevation = terrain.block("elevation", low, 0, count, cols)
            known = np.isfinite(elevation)
            row, col = np.nonzero(known)
            vertices = np.empty(len(row), dtype)
            vertices["x"] = (first_col + col + 0.5) * terrain.resolution
            vertices["y"] = (first_row + low + row + 0.5) * terrain.resolution
            vertices["z"] = elevation[known]
            if sure:
                vertices["sigma"] = np.sqrt(terrain.block("variance", low, 0, count, cols)[known])
            if coloured:
                rgb = colours.read(first_row + low, first_col, count, cols)["rgb"][known]
                for place, (name, _) in enumerate(COLOURS):
                    vertices[name] = rgb[:, place]
            yield vertices

    write_ply(path, dtype, parts(), about)
