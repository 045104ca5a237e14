"""A result log as files: one map of the whole traverse, or the maps and points of every frame.

The log is read once, frame by frame. A regional map is put together from the windows that the frames updated, in memory
that grows with the mapped ground and not with the rectangle around it.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain, count, groupby
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import cv2
import numpy as np

from flow.contracts import nearest
from recordings.atomic_write import written
from recordings.errors import LogError, sentence_of
from recordings.export.georeference import Georeference
from recordings.export.geotiff import write_geotiff
from recordings.export.map_server import write_pgm, write_yaml
from recordings.export.mosaic import STRIP_ROWS, Mosaic
from recordings.export.point_files import CELL_COLOR, add_colors, write_cells, write_points
from recordings.mcap.file import McapFile, iter_decoded
from recordings.ros2 import from_msg as ros2
from recordings.scoring.result_log import without_results
from recordings.sinks.colormaps import hillshade
from stages.data import LEVEL_FRAME, RIM_WIDTH, Array, Cell, ElevationMap, NavigationMap, Tiles

POINTS = "/nav/points"
_SCHEMAS = {"elevation": "grid_map_msgs/msg/GridMap", "navigation": "nav_msgs/msg/OccupancyGrid"}
# The sun of other hillshades: in the north-west, 45 degrees high, where north is the picture's upper edge.
_NORTH_WEST = np.array([-0.5, 0.5, np.sqrt(0.5)])
_ALL = "all layers"  # the name of the file that contains them
_MAX_NAME_BYTES = 100  # of a file that is named after a layer or a frame of reference


class MapTopics(NamedTuple):
    """The topics of maps on one grid: an elevation map, a navigation map or both."""

    elevation: str | None
    navigation: str | None


REGIONAL = MapTopics("/nav/regional_map", "/nav/regional_navigation_map")
FRAME = MapTopics("/nav/elevation_map", "/nav/navigation_map")


def export(
    result: Path | str,
    out: Path | str,
    frames: bool = False,
    lost: Counter[str] | None = None,
    maps: Collection[str] = (),
    places: Mapping[str, Georeference] = MappingProxyType({}),
) -> list[Path]:
    """Write maps of a result log into a folder: GeoTIFF, PNG hillshade, PGM with YAML, PLY.

    Parameters
    ----------
    result
        The log that a run wrote.
    out
        The folder.
    frames
        Write the maps and points of every frame, a folder each, instead of the regional map.
    lost
        If given, a damaged log is exported as far as it is readable, and the reasons of losses are counted here.
    maps
        Streams to write instead of the regional map: an elevation map, a navigation map or one of each on the same
        grid. Maps in frame `level` are written for every frame.
    places
        Frame of reference -> where it is; GeoTIFF and hillshade of regional maps in it are placed there.

    Returns
    -------
    list[Path]
        The files.

    Raises
    ------
    LogError
        If the log is unreadable or has no such map.

    Examples
    --------
    >>> from pathlib import Path
    >>> from recordings.export.bundle import export
    >>> export(Path("out.mcap"), Path("maps"), maps=["regional_map"])  # doctest: +SKIP
    """
    result, out = Path(result), Path(out)
    if not maps:
        topics = FRAME if frames else REGIONAL
    else:
        topics = _topics_of(result, maps)
        frames = frames or _is_in_level(result, topics, lost)
    poses = [] if maps else _export_poses(result, out, lost)
    if frames:
        return _export_frames(result, out, lost, topics, points=not maps) + poses
    return _export_region(result, out, lost, topics, places) + poses


def _topics_of(result: Path, maps: Collection[str]) -> MapTopics:
    """The topics of the streams `maps`."""
    with McapFile(result) as log:
        channels = [channel for number, channel in log.channels.items() if log.count({number})]
        schemas = {channel.topic: getattr(channel.schema, "name", "") for channel in channels}
    reasons = {f"{topic}/reason" for topic in schemas}
    streams = {
        topic.removeprefix("/nav/"): schema
        for topic, schema in sorted(schemas.items())
        if topic.startswith("/nav/") and topic not in reasons and schema in _SCHEMAS.values()
    }
    for name in maps:
        if name not in streams:
            known = ", ".join(streams) or "none"
            raise LogError(f"{result} contains no map '{name}'; its maps: {known}{nearest(name, streams)}")
    found = {kind: [name for name in maps if streams[name] == schema] for kind, schema in _SCHEMAS.items()}
    for kind, names in found.items():
        if len(names) > 1:
            raise LogError(f"{' and '.join(names)} are both {kind} maps; export one at a time")
    return MapTopics(*(f"/nav/{names[0]}" if names else None for names in found.values()))


def _is_in_level(result: Path, topics: MapTopics, lost: Counter[str] | None) -> bool:
    """Whether the maps are in frame `level`."""
    counted_later = None if lost is None else Counter[str]()
    first = next(iter_decoded(result, [topic for topic in topics if topic], counted_later), None)
    return first is not None and first[2].header.frame_id == LEVEL_FRAME


def _messages(result: Path, lost: Counter[str] | None, *topics: str | None) -> Iterator[tuple[int, dict[str, Any]]]:
    """(stamp, topic -> message) of every frame; "level" is the transform of frame `level`."""
    wanted = iter_decoded(result, [*(topic for topic in topics if topic), "/tf"], lost)
    for stamp, group in groupby(wanted, key=lambda item: item[1]):
        frame: dict[str, Any] = {}
        for topic, _, message in group:
            if topic != "/tf":
                frame[topic] = message
                continue
            for item in message.transforms:
                if item.child_frame_id == LEVEL_FRAME:
                    frame["level"] = ros2.transform_of(item)
        yield stamp, frame


@dataclass(eq=False)
class MapFiles:
    """Maps on one grid, as far as they have been read. wanted: layers of the elevation map; none: all."""

    rim: float
    elevation: Mosaic | None = None
    navigation: Mosaic | None = None
    colors: Tiles = field(default_factory=lambda: Tiles(CELL_COLOR))
    stamp: int = 0
    place: Georeference | None = None
    wanted: Collection[str] = ()

    def add(self, result: Path, topics: MapTopics, stamp: int, frame: dict[str, Any]) -> None:
        """Add the maps of a frame."""
        self.stamp = stamp
        if topics.elevation in frame:
            terrain: ElevationMap = _read(ros2.read_grid_map, frame[topics.elevation], result)
            layers = {name: terrain.layers[name] for name in self.wanted or terrain.layers}
            fills = dict.fromkeys(layers, np.float32(np.nan))
            self.elevation = self.elevation or Mosaic(terrain.resolution, terrain.frame_id, fills, self.rim)
            self.elevation.add(layers, np.isfinite(terrain.layers["elevation"]), terrain)
        if topics.navigation in frame:
            cells: NavigationMap = _read(ros2.read_occupancy_grid, frame[topics.navigation], result)
            fill = {"cells": np.int8(Cell.UNKNOWN)}
            self.navigation = self.navigation or Mosaic(cells.resolution, cells.frame_id, fill, self.rim)
            self.navigation.add({"cells": cells.cells}, cells.cells != Cell.UNKNOWN, cells)

    def color(self, result: Path, frame: dict[str, Any]) -> None:
        """Add the colours of a frame's points; also of a frame whose map was left out of the log."""
        if self.elevation is not None and POINTS in frame:
            points = _read(_fields_of, frame[POINTS], result)
            add_colors(self.colors, points, frame["level"], self.elevation.resolution)

    @property
    def bounds(self) -> Mosaic | None:
        """The map whose known cells bound both."""
        return self.elevation or self.navigation

    def close(self) -> bool:
        """Whether any cell is known; the maps are cut to those, the navigation map as the elevation map."""
        if self.bounds is None or not self.bounds.close():
            return False
        return self.navigation is None or self.navigation.close(like=self.bounds)

    def write(self, folder: Path, time: str) -> list[Path]:
        """GeoTIFFs of each layer and of all, hillshade with its world file, and navigation map with its YAML."""
        files = []
        if (terrain := self.elevation) is not None:
            about = _about(terrain.frame_id, time, self.stamp)
            names = file_names([*terrain.fills, _ALL])
            for layer in terrain.fills:
                files.append(_write(folder / f"{names[layer]}.tif", write_geotiff, terrain, [layer], about, self.place))
            every = list(terrain.fills), about, self.place
            files.append(_write(folder / f"{names[_ALL]}.tif", write_geotiff, terrain, *every))
            files.append(_write(folder / "hillshade.png", _write_hillshade, terrain))
            files.append(_write(folder / "hillshade.pgw", _write_world_file, terrain, self.place))
        if self.navigation is not None:
            files.append(_write(folder / "navigation_map.pgm", write_pgm, self.navigation, "cells"))
            files.append(_write(folder / "navigation_map.yaml", write_yaml, "navigation_map.pgm", self.navigation))
        return files


def _export_poses(result: Path, out: Path, lost: Counter[str] | None) -> list[Path]:
    """The poses in each frame of reference, as TUM files: stamp in seconds, x y z, quaternion x y z w in a line."""
    lines: dict[str, list[str]] = {}
    for _, stamp, message in iter_decoded(result, ["/nav/pose"], lost):
        place, turn = message.pose.pose.position, message.pose.pose.orientation
        numbers = (place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w)
        seconds = f"{stamp // 1_000_000_000}.{stamp % 1_000_000_000:09d}"
        line = f"{seconds} {' '.join(f'{number:.9g}' for number in numbers)}\n"
        lines.setdefault(message.header.frame_id, []).append(line)
    folders = _folders(lines)
    return [_write(out / folders[name] / "poses.tum", Path.write_text, "".join(own)) for name, own in lines.items()]


def _export_region(
    result: Path, out: Path, lost: Counter[str] | None, topics: MapTopics, places: Mapping[str, Georeference]
) -> list[Path]:
    """The regional map in `out`; if it was reset, a folder in `out` for each frame of reference."""
    known = regions_of(result, lost, topics)
    folders, files = _folders(known), []
    for name, region in known.items():
        region.place = places.get(name)
        files += region.write(out / folders[name], "up to")
        if region.elevation is not None:
            about = _about(name, "up to", region.stamp)
            path = out / folders[name] / "points.ply"
            files.append(_write(path, write_cells, region.elevation, region.colors, about))
    return files


def regions_of(result: Path, lost: Counter[str] | None, topics: MapTopics, colored: bool = True) -> dict[str, MapFiles]:
    """Frame of reference -> the regional map in it, with the colours of points if `colored`.

    Raises LogError if the log has none, or one without known cells.
    """
    regions: dict[str, MapFiles] = {}
    leading = topics.elevation or topics.navigation
    for stamp, frame in _messages(result, lost, *topics, POINTS if colored else None):
        if leading in frame:
            frame_id = frame[leading].header.frame_id
            regions.setdefault(frame_id, MapFiles(RIM_WIDTH)).add(result, topics, stamp, frame)
        if "level" in frame and frame["level"].parent in regions:
            regions[frame["level"].parent].color(result, frame)
    if not regions:
        _check_damage(result, lost)
        remedy = "add --frames to export the maps of every frame"
        raise without_results(result, (str(leading),), instead=(*map(str, FRAME), POINTS), remedy=remedy)
    known = {name: region for name, region in regions.items() if region.close()}
    if not known:
        raise LogError(f"no cell of {leading} in {result} is known: there is nothing to export")
    return known


def _export_frames(result: Path, out: Path, lost: Counter[str] | None, topics: MapTopics, points: bool) -> list[Path]:
    """The maps of every frame, and its points if `points`, in a folder each."""
    files: list[Path] = []
    number = 0
    for stamp, frame in _messages(result, lost, *topics, POINTS if points else None):
        folder, written_before = out / f"frame-{number:04d}-{stamp}", len(files)
        maps = MapFiles(0.0)
        maps.add(result, topics, stamp, {topic: frame[topic] for topic in topics if topic in frame})
        if maps.close():
            files += maps.write(folder, "at")
        if POINTS in frame:
            fields = _read(_fields_of, frame[POINTS], result)
            files.append(_write(folder / "points.ply", write_points, fields, _about(LEVEL_FRAME, "at", stamp)))
        number += len(files) > written_before
    if not files:
        _check_damage(result, lost)
        raise without_results(result, [*(topic for topic in topics if topic), *([POINTS] if points else [])])
    return files


def _about(frame_id: str, time: str, stamp: int) -> str:
    return f"roverflow: local frame '{frame_id}', metres, z up; {time} {stamp} ns"


def _folders(frames: Collection[str]) -> dict[str, str]:
    """For each frame of reference its folder; none for a single one."""
    return dict.fromkeys(frames, "") if len(frames) == 1 else file_names(frames)


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


def _check_damage(result: Path, lost: Counter[str] | None) -> None:
    """Raise LogError if damage left nothing to export."""
    for why in lost or ():
        raise LogError(f"{result}: {why}; the rest cannot be exported; run the traverse again")


def _fields_of(cloud: Any) -> dict[str, Array]:
    """The fields of a PointCloud2. Raises ValueError if it has no x, y and z."""
    fields: dict[str, Array] = ros2.read_point_cloud(cloud)
    if lacking := {"x", "y", "z"} - fields.keys():
        raise ValueError(f"it lacks {', '.join(sorted(lacking))}")
    return fields


def _read(reader: Callable[[Any], Any], message: Any, result: Path) -> Any:
    try:
        return reader(message)
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        raise LogError(f"{result}: a {message.__msgtype__} in it is invalid: {sentence_of(error)}") from error


def _write(path: Path, write: Callable[..., Any], *arguments: Any) -> Path:
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
