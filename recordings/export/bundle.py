"""A result log as files: one map of the whole traverse, or the maps and points of every frame.

The log is read once, frame by frame. A regional map is put together from the windows that the frames updated, in memory
that grows with the mapped ground and not with the rectangle around it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any

from flow.contracts import nearest
from recordings.errors import LogError
from recordings.export.georeference import ONLY_REGIONAL, Georeference
from recordings.export.map_files import (
    DIAGNOSTICS,
    FRAME,
    POINTS,
    REGIONAL,
    MapFiles,
    MapTopics,
    about_of,
    fields_of,
    file_names,
    part_with,
    read,
    write_whole,
)
from recordings.export.point_files import write_cells, write_points
from recordings.mcap.file import McapFile, by_stamp, iter_decoded
from recordings.ros2 import from_msg as ros2
from recordings.scoring.result_log import without_results
from stages.data import LEVEL_FRAME, Transform

_SCHEMAS = {"elevation": "grid_map_msgs/msg/GridMap", "navigation": "nav_msgs/msg/OccupancyGrid"}


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
        Frame of reference -> where it is; GeoTIFF and hillshade of regional maps in it are placed there. Without any
        of those the export is refused.

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
    if frames and places:
        raise LogError(ONLY_REGIONAL)
    if frames:
        files = _export_frames(result, out, lost, topics, points=not maps)
    else:
        files = _export_region(result, out, lost, topics, places)
    return files if maps else files + _export_poses(result, out, lost)


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


def _frames(
    result: Path, lost: Counter[str] | None, *topics: str | None
) -> Iterator[tuple[int, dict[str, list[Any]], Transform | None]]:
    """(stamp, topic -> messages, transform of frame `level`) of every frame."""
    for stamp, frame in by_stamp(result, [*filter(None, topics), DIAGNOSTICS, "/tf"], lost):
        transforms = chain.from_iterable(message.transforms for message in frame.get("/tf", ()))
        levels = [ros2.transform_of(item) for item in transforms if item.child_frame_id == LEVEL_FRAME]
        yield stamp, frame, levels[-1] if levels else None


def _export_poses(result: Path, out: Path, lost: Counter[str] | None) -> list[Path]:
    """The poses in each frame of reference, as TUM files: stamp in seconds, x y z, quaternion x y z w in a line."""
    lines: dict[str, list[str]] = {}
    for _, _, message in iter_decoded(result, ["/nav/pose"], lost):
        place, turn = message.pose.pose.position, message.pose.pose.orientation
        stamp = ros2.stamp_of(message.header)
        numbers = (place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w)
        seconds = f"{stamp // 1_000_000_000}.{stamp % 1_000_000_000:09d}"
        line = f"{seconds} {' '.join(f'{number:.12g}' for number in numbers)}\n"
        lines.setdefault(message.header.frame_id, []).append(line)
    folders = _folders(lines)
    return [
        write_whole(out / folders[name] / "poses.tum", Path.write_text, "".join(own)) for name, own in lines.items()
    ]


def _export_region(
    result: Path, out: Path, lost: Counter[str] | None, topics: MapTopics, places: Mapping[str, Georeference]
) -> list[Path]:
    """The regional map in `out`; if it was reset, a folder in `out` for each of its parts."""
    remedy = "add --frames to export the maps of every frame"
    known = regions_of(result, lost, topics, f"leave out --crs and {remedy}" if places else remedy)
    if places and all(region.elevation is None or region.frame_id not in places for region in known.values()):
        named = " or ".join(f"'{name}'" for name in places)
        raise LogError(f"--crs georeferences elevation maps, and none in {named} is exported; leave out --crs")
    folders, files = _folders(known), []
    for name, region in known.items():
        region.place = places.get(region.frame_id)
        files += region.write(out / folders[name], "up to")
        if region.elevation is not None:
            about = about_of(region.frame_id, "up to", region.stamp)
            path = out / folders[name] / "points.ply"
            files.append(write_whole(path, write_cells, region.elevation, region.colors, about))
    return files


def regions_of(
    result: Path, lost: Counter[str] | None, topics: MapTopics, remedy: str, colored: bool = True
) -> dict[str, MapFiles]:
    """Name -> each part of the regional map, with the colours of points if `colored`.

    Raises LogError if the log has none, or one without known cells; with the `remedy` if it has maps of frames instead,
    or if a part is too large.
    """
    regions: dict[str, MapFiles] = {}
    newest: dict[str, MapFiles] = {}  # frame of reference -> the part that a frame belongs to
    leading = topics.elevation or topics.navigation
    for stamp, frame, level in _frames(result, lost, *topics, topics.reason, POINTS if colored else None):
        if part := part_with(regions, topics, frame):
            part.add(result, topics, frame)
            newest[part.frame_id] = part
            if part.stamp < stamp:  # its last map came with the first frame of the next part
                del newest[part.frame_id]
        if level is not None and level.parent in newest:
            newest[level.parent].color(result, frame, level)
    if not regions:
        _check_damage(result, lost)
        raise without_results(result, (str(leading),), instead=(*map(str, FRAME), POINTS), remedy=remedy)
    advice = f": did the pose of {result} jump? {remedy}"
    known = {name: region for name, region in regions.items() if region.close(advice)}
    if not known:
        raise LogError(f"no cell of {leading} in {result} is known: there is nothing to export")
    return known


def _export_frames(result: Path, out: Path, lost: Counter[str] | None, topics: MapTopics, points: bool) -> list[Path]:
    """The maps of every frame, and its points if `points`, in a folder each."""
    files: list[Path] = []
    number = 0
    for stamp, frame, _ in _frames(result, lost, *topics, topics.reason, POINTS if points else None):
        folder, written_before = out / f"frame-{number:04d}-{stamp}", len(files)
        maps = MapFiles(0.0)
        maps.add(result, topics, frame)
        if maps.close():
            files += maps.write(folder, "at")
        if POINTS in frame:
            fields = read(fields_of, frame[POINTS][-1], result)
            files.append(write_whole(folder / "points.ply", write_points, fields, about_of(LEVEL_FRAME, "at", stamp)))
        number += len(files) > written_before
    if not files:
        _check_damage(result, lost)
        raise without_results(result, [*(topic for topic in topics if topic), *([POINTS] if points else [])])
    return files


def _folders(frames: Collection[str]) -> dict[str, str]:
    """For each frame of reference, or part of a map, its folder; none for a single one."""
    return dict.fromkeys(frames, "") if len(frames) == 1 else file_names(frames)


def _check_damage(result: Path, lost: Counter[str] | None) -> None:
    """Raise LogError if damage left nothing to export."""
    for why in lost or ():
        raise LogError(f"{result}: {why}; the rest cannot be exported; run the traverse again")
