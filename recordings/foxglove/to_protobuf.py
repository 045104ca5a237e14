"""Turns the ROS 2 messages of a result log into Foxglove messages, which the Foxglove app draws without extensions.

Grids keep every layer as a float32 field, and get colours: heights by elevation, reasons and cells by their codes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.Vector2_pb2 import Vector2
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp

from recordings.sinks.colormaps import CELL_LEGEND, REASON_LEGEND, apply_palette, legend_colors, value_limits
from stages.data import Array, Cell

_LEVELS = (Log.INFO, Log.WARNING, Log.ERROR)  # of a diagnostic status 0, 1, 2
_FLOAT32, _UINT8, _INT8 = PackedElementField.FLOAT32, PackedElementField.UINT8, PackedElementField.INT8
_COLOR_NAMES = ("red", "green", "blue", "alpha")


def foxglove_messages(message: Any) -> Iterator[Any] | None:
    """The Foxglove messages of a ROS 2 message; None if its type has no counterpart."""
    convert = _CONVERSIONS.get(message.__msgtype__)
    return None if convert is None else convert(message)


def _stamped(header: Any) -> dict[str, Any]:
    return {"timestamp": _time(header.stamp), "frame_id": header.frame_id}


def _time(stamp: Any) -> Timestamp:
    return Timestamp(seconds=stamp.sec, nanos=stamp.nanosec)


def _image(message: Any) -> Iterator[Any]:
    yield RawImage(
        **_stamped(message.header), width=message.width, height=message.height, encoding=message.encoding,
        step=message.step, data=message.data.tobytes(),
    )  # fmt: skip


def _compressed(message: Any) -> Iterator[Any]:
    yield CompressedImage(**_stamped(message.header), data=message.data.tobytes(), format=message.format)


def _calibration(message: Any) -> Iterator[Any]:
    matrices = {name: getattr(message, name.lower()).tolist() for name in "DKRP"}
    yield CameraCalibration(
        **_stamped(message.header), width=message.width, height=message.height,
        distortion_model=message.distortion_model, **matrices,
    )  # fmt: skip


def _points(message: Any) -> Iterator[Any]:
    """The same bytes; the packed colour becomes three fields."""
    fields = []
    for known in message.fields:
        if known.name == "rgb":
            places = zip(("blue", "green", "red"), range(3), strict=True)
            fields += [PackedElementField(name=name, offset=known.offset + n, type=_UINT8) for name, n in places]
        else:
            fields.append(PackedElementField(name=known.name, offset=known.offset, type=_FLOAT32))
    yield PointCloud(
        **_stamped(message.header), pose=Pose(orientation=Quaternion(w=1.0)), point_stride=message.point_step,
        fields=fields, data=message.data.tobytes(),
    )  # fmt: skip


def _grid_map(message: Any) -> Iterator[Any]:
    rows, cols = (dim.size for dim in message.data[0].layout.dim)
    layers = {
        name: layer.data.reshape(rows, cols)[::-1, ::-1]
        for name, layer in zip(message.layers, message.data, strict=True)
    }
    shown = layers.get("elevation", next(iter(layers.values())))
    if "reason" in layers:
        colors = legend_colors(shown, REASON_LEGEND)
    else:
        colors = apply_palette(shown, *value_limits(shown), cv2.COLORMAP_TURBO)
    info = message.info
    corner = (info.pose.position.x - info.length_x / 2, info.pose.position.y - info.length_y / 2)
    yield _grid(message.header, corner, info.resolution, layers, colors, np.isfinite(shown))


def _occupancy(message: Any) -> Iterator[Any]:
    info = message.info
    cells = message.data.reshape(info.height, info.width)
    corner = (info.origin.position.x, info.origin.position.y)
    colors = legend_colors(cells, CELL_LEGEND)
    yield _grid(message.header, corner, info.resolution, {"cells": cells}, colors, cells != Cell.UNKNOWN)


def _grid(
    header: Any, corner: tuple[float, float], side: float, layers: Mapping[str, Array], colors: Array, known: Array
) -> Grid:
    """A grid of layers (rows, cols); rows grow with y from `corner`. Unknown cells are transparent."""
    rows, cols = known.shape
    kinds = [(name, layer.dtype.newbyteorder("<")) for name, layer in layers.items()]
    cells = np.zeros((rows, cols), np.dtype([*kinds, *((name, "u1") for name in _COLOR_NAMES)]))
    for name, layer in layers.items():
        cells[name] = layer
    for channel, name in enumerate(_COLOR_NAMES[:3]):
        cells[name] = colors[..., channel]
    cells["alpha"] = np.where(known, 255, 0)
    types = {"f": _FLOAT32, "u": _UINT8, "i": _INT8}
    described: Mapping[str, Any] = cells.dtype.fields or {}
    fields = [
        PackedElementField(name=name, offset=place, type=types[kind.kind])
        for name, (kind, place, *_) in described.items()
    ]
    return Grid(
        **_stamped(header), pose=Pose(position=Vector3(x=corner[0], y=corner[1]), orientation=Quaternion(w=1.0)),
        column_count=cols, cell_size=Vector2(x=side, y=side), row_stride=cols * cells.itemsize,
        cell_stride=cells.itemsize, fields=fields, data=cells.tobytes(),
    )  # fmt: skip


def _odometry(message: Any) -> Iterator[Any]:
    place, turn = message.pose.pose.position, message.pose.pose.orientation
    yield PoseInFrame(**_stamped(message.header), pose=Pose(position=_vector(place), orientation=_quaternion(turn)))


def _vector(vector: Any) -> Vector3:
    return Vector3(x=vector.x, y=vector.y, z=vector.z)


def _quaternion(turn: Any) -> Quaternion:
    return Quaternion(x=turn.x, y=turn.y, z=turn.z, w=turn.w)


def _transforms(message: Any) -> Iterator[Any]:
    yield FrameTransforms(
        transforms=[
            FrameTransform(
                timestamp=_time(item.header.stamp), parent_frame_id=item.header.frame_id,
                child_frame_id=item.child_frame_id, translation=_vector(item.transform.translation),
                rotation=_quaternion(item.transform.rotation),
            )
            for item in message.transforms
        ]
    )  # fmt: skip


def _logs(message: Any) -> Iterator[Any]:
    """A log line for each status."""
    for status in message.status:
        yield Log(
            timestamp=_time(message.header.stamp), level=_LEVELS[status.level], name=status.name, message=status.message
        )


_CONVERSIONS: dict[str, Callable[[Any], Iterator[Any]]] = {
    "stereo_msgs/msg/DisparityImage": lambda message: _image(message.image),
    "sensor_msgs/msg/Image": _image,
    "sensor_msgs/msg/CompressedImage": _compressed,
    "sensor_msgs/msg/CameraInfo": _calibration,
    "sensor_msgs/msg/PointCloud2": _points,
    "grid_map_msgs/msg/GridMap": _grid_map,
    "nav_msgs/msg/OccupancyGrid": _occupancy,
    "nav_msgs/msg/Odometry": _odometry,
    "tf2_msgs/msg/TFMessage": _transforms,
    "diagnostic_msgs/msg/DiagnosticArray": _logs,
}
