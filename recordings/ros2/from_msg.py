"""Our data from ROS 2 messages: calibrations, transforms and poses, and what `to_msg` wrote.

Every function raises LogError, with what is wrong, for a message that does not hold what it should.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recordings.errors import LogError
from recordings.ros2.cdr import LAST_STAMP
from recordings.ros2.to_msg import FLOAT32
from stages.data import Array, CameraModel, Cell, CellReason, ElevationMap, NavigationMap, Pose, Transform

REASON_NOT_RECORDED = 255  # of a hazard in a map read back: an OccupancyGrid alone cannot say why
FARTHEST = 1e9  # m, of a place in any frame


def stamp_of(message_header: Any) -> int:
    """The stamp of a std_msgs/Header in ns."""
    return int(message_header.stamp.sec) * 1_000_000_000 + int(message_header.stamp.nanosec)


def stamp_or(header: Any, log_time: int) -> int:
    """The header's stamp, ns; where the sender left it zero, the time the message was logged."""
    stamp = stamp_of(header)
    if stamp < 0:
        raise LogError(f"its stamp is negative ({stamp} ns)")
    if header.stamp.nanosec >= 1_000_000_000:
        raise LogError(f"its stamp is damaged ({header.stamp.nanosec} ns beyond the second)")
    if not stamp and log_time >= LAST_STAMP:
        raise LogError(
            f"it has no stamp, and was logged at {log_time} ns, which no ROS 2 stamp can be: they end in 2038"
        )
    return stamp or log_time


def frame_of(message: Any) -> str:
    """The frame_id of a message's header, empty where it has none."""
    header = getattr(message, "header", None)
    return frame_name(header.frame_id) if header is not None else ""


def frame_name(text: str) -> str:
    """The name of a frame without the slash in front that ROS 1 gave it."""
    return text.lstrip("/")


def camera_model(info: Any) -> CameraModel:
    """The calibration of a sensor_msgs/CameraInfo, for the part of the sensor and the binning that it tells, in which a
    pixel at u lies at u / binning (as image_geometry has it)."""
    roi, across, down = info.roi, max(int(info.binning_x), 1), max(int(info.binning_y), 1)
    x, y = float(roi.x_offset), float(roi.y_offset)
    taken = np.array([[1 / across, 0, -x / across], [0, 1 / down, -y / down], [0, 0, 1]])
    k, p = info.k.reshape(3, 3), info.p.reshape(3, 4)
    return CameraModel(
        width=int(roi.width or info.width) // across, height=int(roi.height or info.height) // down,
        k=taken @ k if k.any() else k, d=info.d, r=info.r.reshape(3, 3), p=taken @ p if p.any() else p,
        model=info.distortion_model or "plumb_bob",
    )  # fmt: skip


def transform_of(message: Any) -> Transform:
    """The transform of a geometry_msgs/TransformStamped."""
    moved, turned = message.transform.translation, message.transform.rotation
    parent, child = frame_of(message), frame_name(message.child_frame_id)
    name = f"the transform '{parent}' <- '{child}'"
    if not parent or not child:
        raise LogError(f"{name} lacks the name of a frame")
    translation = _place(moved, f"the translation of {name}")
    return Transform(parent, child, rotation_of(turned, name).as_matrix(), translation)


def _place(vector: Any, what: str) -> Array:
    """A geometry_msgs/Vector3 or Point (3,), m, where it is one of this world."""
    place = np.array([vector.x, vector.y, vector.z])
    if not (np.abs(place) < FARTHEST).all():  # or NaN
        raise LogError(f"{what} is {place.tolist()}, which is no place")
    return place


def rotation_of(quaternion: Any, what: str) -> Rotation:
    """The rotation of a geometry_msgs/Quaternion that is a unit quaternion, or nearly."""
    values = np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w])
    length = float(np.linalg.norm(values))
    if not abs(length - 1) < 1e-2:
        raise LogError(
            f"the quaternion of {what} is not a rotation: {values.tolist()} has the length {length:.3g}, not 1"
        )
    return Rotation.from_quat(values)


def pose_of(message: Any, log_time: int, base_frame: str) -> Pose | None:
    """The pose of nav_msgs/Odometry, geometry_msgs/PoseStamped or PoseWithCovarianceStamped, or that of `base_frame` in
    a tf2_msgs/TFMessage, None where it holds others only.

    base_frame: whose pose it is where the message does not say.
    """
    if hasattr(message, "transforms"):
        moved = next((t for t in message.transforms if frame_name(t.child_frame_id) == base_frame), None)
        if moved is None:
            return None
        at = transform_of(moved)
        quaternion = rotation_of(moved.transform.rotation, "the pose").as_quat()
        return Pose(stamp_or(moved.header, log_time), at.translation, quaternion, at.parent, base_frame)
    placed = message.pose if hasattr(message.pose, "covariance") else None
    pose = message.pose.pose if placed is not None else message.pose
    covariance = placed.covariance.reshape(6, 6) if placed is not None else None
    if covariance is not None and (not covariance.any() or covariance[0, 0] < 0):
        covariance = None  # all zero or -1: not known
    position = _place(pose.position, "the position of the pose")
    child = frame_name(getattr(message, "child_frame_id", "")) or base_frame
    return Pose(
        stamp_or(message.header, log_time), position, rotation_of(pose.orientation, "the pose").as_quat(),
        frame_of(message), child, covariance,
    )  # fmt: skip


def read_disparity(message: Any) -> NDArray[np.float32]:
    """The (H, W) float32 pixels of a stereo_msgs/DisparityImage, NaN = unknown, as `disparity_image` wrote them."""
    picture = message.image
    if picture.encoding != "32FC1":
        raise ValueError(f"a disparity image must be 32FC1, not {picture.encoding}")
    order = ">" if picture.is_bigendian else "<"
    rows = np.asarray(picture.data, dtype=np.uint8).reshape(picture.height, picture.step)
    return np.ascontiguousarray(rows[:, : 4 * picture.width]).view(f"{order}f4").astype(np.float32)


def read_point_cloud(message: Any) -> dict[str, Array]:
    """The fields of a sensor_msgs/PointCloud2 of float32 fields, name -> (N,); "rgb" comes as (N, 3) uint8 "colors"."""
    if any(known.datatype != FLOAT32 or known.count != 1 for known in message.fields):
        raise ValueError("a point cloud with other fields than single float32 is not read")
    order, names = ">" if message.is_bigendian else "<", [known.name for known in message.fields]
    layout = {
        "names": names, "formats": [f"{order}f4"] * len(names), "offsets": [known.offset for known in message.fields],
        "itemsize": message.point_step,
    }  # fmt: skip
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.row_step)
    packed = np.ascontiguousarray(rows[:, : message.width * message.point_step]).view(np.dtype(layout)).reshape(-1)  # type: ignore[call-overload]
    fields: dict[str, Array] = {name: packed[name].astype(np.float32) for name in names if name != "rgb"}
    if "rgb" in names:
        bits = np.ascontiguousarray(packed["rgb"]).view(f"{order}u4")
        fields["colors"] = np.stack([bits >> shift & 0xFF for shift in (16, 8, 0)], axis=1).astype(np.uint8)
    return fields


def read_grid_map(message: Any) -> ElevationMap:
    """The ElevationMap that `grid_map` wrote, or any axis-aligned GridMap with a layer "elevation".

    A map that was moved in its circular buffer (start indices) is unrolled.
    """
    info, centre = message.info, message.info.pose.position
    return ElevationMap(
        stamp_of(message.header), _layers(message), float(info.resolution),
        (centre.x - info.length_x / 2, centre.y - info.length_y / 2), message.header.frame_id,
    )  # fmt: skip


def _layers(message: Any) -> dict[str, Array]:
    """The layers of a GridMap, (rows, cols) float32 each."""
    layers = {}
    for name, array in zip(message.layers, message.data, strict=True):
        outer, inner = array.layout.dim
        if outer.label != "column_index":
            raise ValueError(f"grid map layer '{name}' is stored by {outer.label}; only column-major maps are read")
        stored = np.asarray(array.data, np.float32)[array.layout.data_offset :].reshape(outer.size, inner.size)
        # outer_start_index counts along the matrix' first index (-x), inner_start_index along its second (-y).
        unrolled = np.roll(stored, (-message.inner_start_index, -message.outer_start_index), axis=(0, 1))
        layers[name] = np.ascontiguousarray(unrolled[::-1, ::-1])
    return layers


def read_occupancy_grid(message: Any, reasons: Any = None) -> NavigationMap:
    """The NavigationMap of an OccupancyGrid and, where given, of its `reason_map`; an OccupancyGrid alone cannot say
    why a cell is a hazard: `REASON_NOT_RECORDED`."""
    info = message.info
    cells = np.asarray(message.data, np.int8).reshape(info.height, info.width)
    reason = np.full(cells.shape, REASON_NOT_RECORDED, np.uint8)
    reason[cells == Cell.FREE] = CellReason.CLEAR
    reason[cells == Cell.UNKNOWN] = CellReason.UNOBSERVED
    if reasons is not None:
        reason = _layers(reasons)["reason"].astype(np.uint8)
    resolution = float(str(np.float32(info.resolution)))  # the message holds float32: 0.05 stays 0.05
    origin = (float(info.origin.position.x), float(info.origin.position.y))
    return NavigationMap(stamp_of(message.header), cells, reason, resolution, origin, message.header.frame_id)
