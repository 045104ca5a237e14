"""Data from ROS 2 messages: calibrations, transforms and poses, and readers of exactly what `to_msg` writes.

The functions raise LogError for a message with invalid content.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recordings.errors import LogError
from recordings.ros2.cdr import LAST_STAMP
from recordings.ros2.to_msg import FLOAT32
from stages.data import LEVEL_FRAME, Array, CameraModel, Cell, CellReason, ElevationMap, NavigationMap, Pose, Transform
from stages.data.rotations import matrix_of, unit

REASON_NOT_RECORDED = 255  # of a hazard in an OccupancyGrid without its `reason_map`
MAX_DISTANCE_M = 1e9


def stamp_of(message_header: Any) -> int:
    """The stamp of a std_msgs/Header, ns."""
    return int(message_header.stamp.sec) * 1_000_000_000 + int(message_header.stamp.nanosec)


def stamp_or(header: Any, log_time: int) -> int:
    """The header's stamp, ns; if it is zero, the log time."""
    stamp = stamp_of(header)
    if stamp < 0:
        raise LogError(f"its stamp is negative ({stamp} ns)")
    if header.stamp.nanosec >= 1_000_000_000:
        raise LogError(f"its stamp is damaged ({header.stamp.nanosec} ns beyond the second)")
    if not stamp and log_time >= LAST_STAMP:
        raise LogError(f"it has no stamp, and its log time {log_time} ns is beyond ROS 2 stamps, which end in 2038")
    return stamp or log_time


def frame_of(message: Any) -> str:
    """The frame_id of a message's header, or an empty string."""
    header = getattr(message, "header", None)
    return frame_name(header.frame_id) if header is not None else ""


def frame_name(text: str) -> str:
    """The name of a frame without the leading slash of ROS 1."""
    return text.lstrip("/")


def camera_model(info: Any) -> CameraModel:
    """The calibration of a sensor_msgs/CameraInfo, after its region of interest and binning (as in image_geometry)."""
    roi, across, down = info.roi, max(int(info.binning_x), 1), max(int(info.binning_y), 1)
    x, y = float(roi.x_offset), float(roi.y_offset)
    scaled = np.array([[1 / across, 0, -x / across], [0, 1 / down, -y / down], [0, 0, 1]])
    k, p = info.k.reshape(3, 3), info.p.reshape(3, 4)
    return CameraModel(
        width=int(roi.width or info.width) // across, height=int(roi.height or info.height) // down,
        k=scaled @ k if k.any() else k, d=info.d, r=info.r.reshape(3, 3), p=scaled @ p if p.any() else p,
        model=info.distortion_model or "plumb_bob",
    )  # fmt: skip


def transform_of(message: Any) -> Transform:
    """The transform of a geometry_msgs/TransformStamped."""
    transform = message.transform
    parent, child = frame_of(message), frame_name(message.child_frame_id)
    name = f"the transform '{parent}' <- '{child}'"
    if not parent or not child:
        raise LogError(f"{name} lacks the name of a frame")
    translation = _finite(transform.translation, f"the translation of {name}")
    return Transform(parent, child, matrix_of(unit_quaternion(transform.rotation, name)), translation)


def _finite(vector: Any, what: str) -> Array:
    """A geometry_msgs/Vector3 or Point (3,), m, below `MAX_DISTANCE_M`."""
    values = np.array([vector.x, vector.y, vector.z])
    if not (np.abs(values) < MAX_DISTANCE_M).all():  # or NaN
        raise LogError(f"{what} is {values.tolist()}, which is not a position")
    return values


def unit_quaternion(quaternion: Any, what: str) -> tuple[float, float, float, float]:
    """x, y, z and w of a geometry_msgs/Quaternion of length 1, within 1 %; the length is then 1."""
    values = (float(quaternion.x), float(quaternion.y), float(quaternion.z), float(quaternion.w))
    length = math.hypot(*values)
    if not abs(length - 1) < 1e-2:
        raise LogError(f"the quaternion of {what} is not a rotation: {[*values]} has the length {length:.3g}, not 1")
    x, y, z, w = values
    return x / length, y / length, z / length, w / length


def pose_of(message: Any, log_time: int, base_frame: str) -> Pose | None:
    """The pose of an Odometry, PoseStamped or PoseWithCovarianceStamped, or of `base_frame` in a TFMessage.

    base_frame: whose pose it is if the message does not name a child frame. None if a TFMessage does not contain it.
    """
    if hasattr(message, "transforms"):
        transform = next((t for t in message.transforms if frame_name(t.child_frame_id) == base_frame), None)
        if transform is None:
            return None
        at = transform_of(transform)
        quaternion = unit(unit_quaternion(transform.transform.rotation, "the pose"))
        return Pose(stamp_or(transform.header, log_time), at.translation, quaternion, at.parent, base_frame)
    stated = message.pose if hasattr(message.pose, "covariance") else None
    pose = message.pose.pose if stated is not None else message.pose
    covariance = stated.covariance.reshape(6, 6) if stated is not None else None
    if covariance is not None and (not covariance.any() or covariance[0, 0] < 0):
        covariance = None  # zeros or -1: unknown
    position = _finite(pose.position, "the position of the pose")
    child = frame_name(getattr(message, "child_frame_id", "")) or base_frame
    return Pose(
        stamp_or(message.header, log_time), position, unit(unit_quaternion(pose.orientation, "the pose")),
        frame_of(message), child, covariance,
    )  # fmt: skip


def read_disparity(message: Any) -> NDArray[np.float32]:
    """The pixels of a stereo_msgs/DisparityImage, (H, W) float32, px, NaN = unknown. Raises ValueError unless 32FC1.

    >>> from recordings.ros2.to_msg import disparity_image
    >>> from stages.data import Disparity
    >>> pixels = np.full((1, 2), 7.5, np.float32)
    >>> read_disparity(disparity_image(Disparity(0, pixels, np.ones((1, 2), np.uint8), np.ones_like(pixels))))
    array([[7.5, 7.5]], dtype=float32)
    """
    picture = message.image
    if picture.encoding != "32FC1":
        raise ValueError(f"a disparity image must be 32FC1, not {picture.encoding}")
    return np.array(picture.data, np.uint8).view(np.float32).reshape(picture.height, picture.width)


def read_point_cloud(message: Any) -> dict[str, Array]:
    """The fields of a sensor_msgs/PointCloud2: name -> (N,) float32; the field "rgb" becomes "colors", (N, 3) uint8.

    Raises ValueError if a field is not a single float32.
    """
    if any(known.datatype != FLOAT32 or known.count != 1 for known in message.fields):
        raise ValueError("a point cloud must have fields of one float32 each")
    names = [known.name for known in message.fields]
    points = np.array(message.data, np.uint8).view(np.float32).reshape(message.width, len(names))
    fields: dict[str, Array] = {name: points[:, n].copy() for n, name in enumerate(names) if name != "rgb"}
    if "rgb" in names:
        bits = points[:, names.index("rgb")].copy().view(np.uint32)
        fields["colors"] = np.stack([bits >> shift & 0xFF for shift in (16, 8, 0)], axis=1).astype(np.uint8)
    return fields


def read_grid_map(message: Any) -> ElevationMap:
    """All layers of a grid_map_msgs/GridMap with a layer "elevation"."""
    info, centre = message.info, message.info.pose.position
    return ElevationMap(
        stamp_of(message.header), read_layers(message), float(info.resolution),
        (centre.x - info.length_x / 2, centre.y - info.length_y / 2), message.header.frame_id,
    )  # fmt: skip


def read_regional_map(messages: Mapping[str, Sequence[Any]], topic: str, stamp: int) -> ElevationMap:
    """A regional map among the messages of a stamp, with its epoch, and with frame `level` if it is of that stamp."""
    terrain = read_grid_map(messages[topic][-1])
    level = level_in(messages.get("/tf", ()), terrain.frame_id) if terrain.stamp == stamp else None
    return replace(terrain, level=level, epoch=epoch_of(messages.get("/nav/diagnostics", ()), topic))


def epoch_of(messages: Iterable[Any], topic: str | None) -> int | None:
    """The epoch, ns, of the map of a topic, by the diagnostics of its stamp; None if they do not contain it."""
    for status in chain.from_iterable(message.status for message in messages):
        for pair in status.values if f"/nav/{status.name}" == topic else ():
            if pair.key == "epoch" and pair.value.removeprefix("-").isdecimal():
                return int(pair.value)
    return None


def losses_in(message: Any) -> Iterator[tuple[str, str, str, str]]:
    """Stream, stamp, reason and detail of each loss in the diagnostics of a result log."""
    for status in message.status:
        found = {pair.key: pair.value for pair in status.values}
        if "reason" in found:
            yield found["stream"], found["stamp"], found["reason"], status.message


def level_in(messages: Iterable[Any], parent: str) -> Transform | None:
    """Frame `level` in a frame of reference, by the messages of a stamp: /tf may have several."""
    for item in chain.from_iterable(getattr(message, "transforms", ()) for message in messages):
        if item.child_frame_id == LEVEL_FRAME and item.header.frame_id == parent:
            return transform_of(item)
    return None


def read_layers(message: Any) -> dict[str, Array]:
    """The layers of a GridMap, (rows, cols) float32 each."""
    layers = {}
    for name, array in zip(message.layers, message.data, strict=True):
        outer, inner = array.layout.dim
        stored = np.asarray(array.data, np.float32).reshape(outer.size, inner.size)
        layers[name] = np.ascontiguousarray(stored[::-1, ::-1])
    return layers


def read_occupancy_grid(message: Any, reasons: Any = None, like: Any = None) -> NavigationMap:
    """Cells and reasons of a nav_msgs/OccupancyGrid.

    reasons: its `reason_map`, a grid_map_msgs/GridMap; without it the reason of a hazard is `REASON_NOT_RECORDED`;
    like: another GridMap on its cells.
    """
    info = message.info
    cells = np.asarray(message.data, np.int8).reshape(info.height, info.width)
    reason = np.full(cells.shape, REASON_NOT_RECORDED, np.uint8)
    reason[cells == Cell.FREE] = CellReason.CLEAR
    reason[cells == Cell.UNKNOWN] = CellReason.UNOBSERVED
    if reasons is not None:
        reason = read_layers(reasons)["reason"].astype(np.uint8)
    origin = (float(info.origin.position.x), float(info.origin.position.y))
    size = _cell_size(info, reasons, like)
    return NavigationMap(stamp_of(message.header), cells, reason, size, origin, message.header.frame_id)


def _cell_size(info: Any, *grids: Any) -> float:
    """The cell size of a nav_msgs/MapMetaData, m: the float64 of a GridMap on its cells, else its shortest decimal."""
    stored = np.float32(info.resolution)
    exact = [float(grid.info.resolution) for grid in grids if grid is not None]
    return next((size for size in exact if np.float32(size) == stored), float(str(stored)))
