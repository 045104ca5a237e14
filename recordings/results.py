"""Reads a result log as data types, frame by frame: for notebooks."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from recordings.errors import LogError
from recordings.mcap.file import McapFile, by_stamp
from recordings.ros2 import from_msg as ros2
from recordings.ros2.plain import array_of
from recordings.scoring.result_log import check_profile, facts_of
from stages.data import Disparity, StereoCamera


@dataclass(frozen=True, eq=False)
class ResultFrame:
    """What a result log contains at one stamp.

    Attributes
    ----------
    stamp : int
        Nanoseconds.
    items : dict
        Stream -> `Disparity`, `ElevationMap`, `NavigationMap`, `Pose`, number, text or array (of an image, its
        pixels); of a cloud its fields, name -> (N,) array.
    """

    stamp: int
    items: Mapping[str, Any]


def read_result(path: Path | str, streams: Collection[str] = ()) -> Iterator[ResultFrame]:
    """The frames of a result log, in their order.

    Parameters
    ----------
    path : Path
        A log that `roverflow run` wrote.
    streams : collection of str, optional
        Names such as "elevation_map" or "pose", or one name; all by default.

    Yields
    ------
    ResultFrame
        A log keeps no confidence and sigma of disparities: NaN and None. The camera's principal points are equal,
        because disparities in a log include their difference. Regional maps come once a step of the rover.

    Raises
    ------
    LogError
        If the log is not a result log, is damaged, or has no such stream.

    Examples
    --------
    >>> from recordings.results import read_result
    >>> for frame in read_result("out.mcap", ["navigation_map"]):  # doctest: +SKIP
    ...     print(frame.stamp, (frame.items["navigation_map"].cells == 100).sum())
    """
    path, streams = Path(path), [streams] if isinstance(streams, str) else [*streams]
    check_profile(path, facts_of(path, "a log that roverflow run wrote"))
    with McapFile(path) as log:
        schemas = {channel.topic: getattr(channel.schema, "name", "") for channel in log.channels.values()}
    parts = {
        topic: {f"{topic}/{part}" for part in _PARTS.get(schema, ())} & schemas.keys()
        for topic, schema in schemas.items()
    }
    belonging = set().union(*parts.values())
    known = {
        topic.removeprefix("/nav/"): topic
        for topic, schema in sorted(schemas.items())
        if topic.startswith("/nav/") and schema in _READERS and topic not in belonging
    }
    for name in sorted(set(streams) - known.keys()):
        if other := schemas.get(f"/nav/{name}"):
            raise LogError(f"{path}: stream '{name}' is {other}, which read_result does not read; it reads {_READABLE}")
        raise LogError(f"{path} has no stream '{name}', only {', '.join(known)}")
    chosen = {known[name] for name in streams or known}
    read = chosen.union(*(parts[topic] for topic in chosen))
    if any(schemas[topic] == _GRID_MAP for topic in chosen):
        read |= {"/tf", "/nav/diagnostics"}
    for stamp, messages in by_stamp(path, read):
        if items := dict(_items(messages, stamp, chosen, schemas)):
            yield ResultFrame(stamp, items)


def _items(
    messages: Mapping[str, Sequence[Any]], stamp: int, chosen: Collection[str], schemas: Mapping[str, str]
) -> Iterator[tuple[str, Any]]:
    """(Stream, item) of the messages of a stamp."""
    last = {topic: found[-1] for topic, found in messages.items()}
    for topic in sorted(last.keys() & set(chosen)):
        schema = schemas[topic]
        if schema == _GRID_MAP:
            item: Any = ros2.read_regional_map(messages, topic, stamp)
        else:
            parts = (last.get(f"{topic}/{part}") for part in _PARTS.get(schema, ()))
            item = _READERS[schema](last[topic], *parts)
        yield topic.removeprefix("/nav/"), item


def _disparity(message: Any, origins: Any, info: Any) -> Disparity:
    pixels = ros2.read_disparity(message)
    unstated = np.full(pixels.shape, np.nan, np.float32)
    source = np.isfinite(pixels).astype(np.uint8) if origins is None else np.asarray(origins.data).reshape(pixels.shape)
    camera = None
    if info is not None:
        (fx, _, cx), (_, fy, cy), _ = np.reshape(info.k, (3, 3)).tolist()
        camera = StereoCamera(fx, fy, cx, cy, message.t, info.width, info.height, frame_id=ros2.frame_of(info))
    return Disparity(ros2.stamp_of(message.header), pixels, source, unstated, camera=camera)


_GRID_MAP = "grid_map_msgs/msg/GridMap"
# Schema -> the ends of further topics, whose messages its reader gets with the message
_PARTS = {"stereo_msgs/msg/DisparityImage": ("source", "camera_info"), "nav_msgs/msg/OccupancyGrid": ("reason",)}
_READERS: dict[str, Callable[..., Any]] = {
    "stereo_msgs/msg/DisparityImage": _disparity,
    "nav_msgs/msg/OccupancyGrid": ros2.read_occupancy_grid,
    _GRID_MAP: ros2.read_grid_map,
    "nav_msgs/msg/Odometry": lambda message: ros2.pose_of(message, 0, "base_link"),
    "sensor_msgs/msg/PointCloud2": ros2.read_point_cloud,
    **dict.fromkeys(
        ("sensor_msgs/msg/Image", "std_msgs/msg/Float64MultiArray", "std_msgs/msg/Int64MultiArray"), array_of
    ),
    **dict.fromkeys(
        ("std_msgs/msg/Float64", "std_msgs/msg/Int64", "std_msgs/msg/Bool", "std_msgs/msg/String"), attrgetter("data")
    ),
}
_READABLE = ", ".join(name.rpartition("/")[2] for name in _READERS)
