"""Maps of a result log on one grid, and the files that show them: GeoTIFF, hillshade, PGM with YAML."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, count
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from recordings.atomic_write import written
from recordings.errors import LogError, sentence_of
from recordings.export.georeference import Georeference
from recordings.export.geotiff import write_geotiff
from recordings.export.map_server import write_pgm, write_yaml
from recordings.export.mosaic import STRIP_ROWS, Mosaic
from recordings.export.point_files import CELL_COLOR, add_colors
from recordings.ros2 import from_msg as ros2
from recordings.sinks.colormaps import hillshade
from stages.data import RIM_WIDTH, Array, Cell, ElevationMap, NavigationMap, Tiles, Transform

POINTS, DIAGNOSTICS = "/nav/points", "/nav/diagnostics"
# The sun of other hillshades: in the north-west, 45 degrees high, where north is the picture's upper edge.
_NORTH_WEST = np.array([-0.5, 0.5, np.sqrt(0.5)])
_ALL = "all layers"  # the name of the file that contains them
_MAX_NAME_BYTES = 100  # of a file that is named after a layer or a frame of reference


class MapTopics(NamedTuple):
    """The topics of maps on one grid: an elevation map, a navigation map or both."""

    elevation: str | None
    navigation: str | None

    @property
    def reason(self) -> str | None:
        """The topic of the navigation map's reasons, which contain its exact cell size."""
        return self.navigation and f"{self.navigation}/reason"


REGIONAL = MapTopics("/nav/regional_map", "/nav/regional_navigation_map")
FRAME = MapTopics("/nav/elevation_map", "/nav/navigation_map")


@dataclass(eq=False)
class MapFiles:
    """Maps on one grid, as far as they have been read.

    wanted: layers of the elevation map; none: all; epoch: ns, from which the layers "first" and "last" count; stamp:
    of the last map, ns, which may be earlier than the frame that it came with.
    """

    rim: float
    frame_id: str = ""
    epoch: int | None = None
    elevation: Mosaic | None = None
    navigation: Mosaic | None = None
    colors: Tiles = field(default_factory=lambda: Tiles(CELL_COLOR))
    stamp: int = 0
    place: Georeference | None = None
    wanted: Collection[str] = ()

    def add(self, result: Path, topics: MapTopics, frame: dict[str, list[Any]]) -> None:
        """Add the maps of a frame."""
        if topics.elevation in frame:
            terrain: ElevationMap = read(ros2.read_grid_map, frame[topics.elevation][-1], result)
            self.stamp = terrain.stamp
            layers = {name: terrain.layers[name] for name in self.wanted or terrain.layers}
            fills = dict.fromkeys(layers, np.float32(np.nan))
            self.elevation = self.elevation or Mosaic(terrain.resolution, terrain.frame_id, fills, self.rim)
            self.elevation.add(layers, np.isfinite(terrain.layers["elevation"]), terrain)
        if topics.navigation in frame:
            like = next((frame[topic][-1] for topic in (topics.elevation, topics.reason) if topic in frame), None)
            reader = partial(ros2.read_occupancy_grid, like=like)
            cells: NavigationMap = read(reader, frame[topics.navigation][-1], result)
            self.stamp = cells.stamp
            fill = {"cells": np.int8(Cell.UNKNOWN)}
            self.navigation = self.navigation or Mosaic(cells.resolution, cells.frame_id, fill, self.rim)
            self.navigation.add({"cells": cells.cells}, cells.cells != Cell.UNKNOWN, cells)

    def color(self, result: Path, frame: dict[str, list[Any]], level: Transform) -> None:
        """Add the colours of a frame's points; also of a frame whose map was left out of the log."""
        if self.elevation is not None and POINTS in frame:
            points = read(fields_of, frame[POINTS][-1], result)
            add_colors(self.colors, points, level, self.elevation.resolution)

    @property
    def bounds(self) -> Mosaic | None:
        """The map whose known cells bound both."""
        return self.elevation or self.navigation

    def close(self, advice: str = "") -> bool:
        """Whether any cell is known; the maps are cut to those, the navigation map as the elevation map.

        Raises LogError if the two differ in their grids or, with `advice`, if they are too large.
        """
        if self.bounds is None or not self.bounds.close(advice=advice):
            return False
        if self.navigation is not None and not self.bounds.has_grid(self.navigation):
            grids = sorted((each.frame_id, each.resolution) for each in (self.bounds, self.navigation))
            found = " and ".join(f"in '{name}' with cells of {size:g} m" for name, size in grids)
            raise LogError(f"the elevation map and the navigation map differ: {found}; export one at a time")
        return self.navigation is None or self.navigation.close(like=self.bounds)

    def write(self, folder: Path, time: str) -> list[Path]:
        """GeoTIFFs of each layer and of all, hillshade with its world file, and navigation map with its YAML."""
        files = []
        if (terrain := self.elevation) is not None:
            about = about_of(terrain.frame_id, time, self.stamp)
            if self.epoch is not None:
                about += f"; first and last count from {self.epoch} ns"
            names = file_names([*terrain.fills, _ALL])
            for layer in terrain.fills:
                files.append(
                    write_whole(folder / f"{names[layer]}.tif", write_geotiff, terrain, [layer], about, self.place)
                )
            every = list(terrain.fills), about, self.place
            files.append(write_whole(folder / f"{names[_ALL]}.tif", write_geotiff, terrain, *every))
            files.append(write_whole(folder / "hillshade.png", _write_hillshade, terrain))
            files.append(write_whole(folder / "hillshade.pgw", _write_world_file, terrain, self.place))
        if self.navigation is not None:
            files.append(write_whole(folder / "navigation_map.pgm", write_pgm, self.navigation, "cells"))
            files.append(write_whole(folder / "navigation_map.yaml", write_yaml, "navigation_map.pgm", self.navigation))
        return files


def part_with(
    regions: dict[str, MapFiles], topics: MapTopics, frame: dict[str, list[Any]], wanted: Collection[str] = ()
) -> MapFiles | None:
    """The part of a regional map that the maps of a frame belong to, new in `regions` where it begins; None without.

    A part begins where the map was reset: it has a frame of reference or an epoch of its own. A map whose epoch is lost
    belongs to the newest part.
    """
    topic = next((topic for topic in topics if topic in frame), None)
    if topic is None:
        return None
    frame_id = frame[topic][-1].header.frame_id
    epoch = ros2.epoch_of(frame.get(DIAGNOSTICS, ()), topics.elevation or REGIONAL.elevation)
    parts = [part for part in regions.values() if part.frame_id == frame_id]
    for part in reversed(parts):
        if epoch is None or part.epoch in (None, epoch):
            part.epoch = epoch if part.epoch is None else part.epoch
            return part
    name = f"{frame_id}/part-{len(parts) + 1}" if parts else frame_id
    regions[name] = MapFiles(RIM_WIDTH, frame_id, epoch, wanted=wanted)
    return regions[name]


def about_of(frame_id: str, time: str, stamp: int) -> str:
    """The comment of a file: its frame of reference, units and time."""
    return f"roverflow: local frame '{frame_id}', metres, z up; {time} {stamp} ns"


def file_names(names: Iterable[str]) -> dict[str, str]:
    """For each name a file name of its own, without characters that lead out of the folder."""
    chosen: dict[str, str] = {}
    for name in names:
        short = re.sub(r"[^\w.-]", "-", name).encode()[:_MAX_NAME_BYTES].decode(errors="ignore")
        plain = short.lstrip(".") or "unnamed"
        others = {other.casefold() for other in chosen.values()}
        numbered = (f"{plain}{number}" for number in chain([""], (f"-{number}" for number in count(2))))
        chosen[name] = next(other for other in numbered if other.casefold() not in others)
    return chosen


def fields_of(cloud: Any) -> dict[str, Array]:
    """The fields of a PointCloud2. Raises ValueError if it has no x, y and z."""
    fields: dict[str, Array] = ros2.read_point_cloud(cloud)
    if lacking := {"x", "y", "z"} - fields.keys():
        raise ValueError(f"it lacks {', '.join(sorted(lacking))}")
    return fields


def read(reader: Callable[[Any], Any], message: Any, result: Path) -> Any:
    """What a reader makes of a message of a result log. Raises LogError for an invalid one."""
    try:
        return reader(message)
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        raise LogError(f"{result}: a {message.__msgtype__} in it is invalid: {sentence_of(error)}") from error


def write_whole(path: Path, write: Callable[..., Any], *arguments: Any) -> Path:
    """Write a whole file or none, and its folder where it is missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with written(path) as temporary:
        write(temporary, *arguments)
    return path


def _write_hillshade(path: Path, terrain: Mosaic) -> None:
    """1 to 255, brightest where the sun is perpendicular, and 0 where nothing is known."""
    shades = np.zeros(terrain.shape, np.uint8)
    rows = terrain.shape[0]
    for low in range(0, rows, STRIP_ROWS):
        high = min(rows, low + STRIP_ROWS)
        # With a row on either side, so that slopes are those of the whole map.
        block = terrain.block("elevation", low - 1, 0, high - low + 2, terrain.shape[1])
        lit = np.where(np.isfinite(block), 1 + 254 * hillshade(block, terrain.resolution, _NORTH_WEST), 0)
        shades[rows - high : rows - low] = np.rint(lit[1:-1]).astype(np.uint8)[::-1]
    _, blob = cv2.imencode(".png", shades)
    path.write_bytes(blob.tobytes())


def _write_world_file(path: Path, terrain: Mosaic, place: Georeference | None) -> None:
    """Six lines: the steps from a cell to the next one and to the next row, and the centre of the upper left cell."""
    (x, y), step, rows = terrain.origin, terrain.resolution, terrain.shape[0]
    lines = (step, 0.0, 0.0, -step, x + step / 2, y + (rows - 0.5) * step)
    if place is not None:
        a, b, _, east, d, e, _, north, *_ = place.matrix(step, *lines[4:])
        lines = (a, d, b, e, east, north)
    path.write_text("".join(f"{value:.9f}\n" for value in lines))
