"""Foxglove's messages as those of ROS 2, from protobuf, JSON or CDR.

The fields are those of foxglove-sdk's schemas. Bytes are base64 in JSON, and times have other names in each encoding.
"""

from __future__ import annotations

from binascii import a2b_base64
from collections.abc import Callable, Iterable
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np

from recordings.errors import LogError
from recordings.video.formats import VIDEO
from stages.data import Array

_DISTORTIONS = {"kannala_brandt": "equidistant", "rational_polynomial": "rational_polynomial"}
_MAX_SECONDS = 1 << 32  # also of nanoseconds; ROS has 32 bits for each
_PACKAGES = ("foxglove.", "foxglove_msgs/msg/", "foxglove_msgs/")

Adapter = Callable[[Any], Any]


def adapter_of(schema_name: str) -> tuple[str, Adapter] | None:
    """The ROS 2 type of one of Foxglove's schemas, and a function to its messages; None for other schemas."""
    for package in _PACKAGES:
        if schema_name.startswith(package):
            return _ADAPTERS.get(schema_name.removeprefix(package))
    return None


def with_header(message: Any) -> Any:
    """A message of any type with a header of its `timestamp` and `frame_id`, if it has no header of its own."""
    names = [known.name for known in message.DESCRIPTOR.fields] if hasattr(message, "DESCRIPTOR") else vars(message)
    fields = {name: getattr(message, name) for name in names}
    if "header" in fields or "timestamp" in fields:
        fields["header"] = _header(fields.get("header", message))
    return SimpleNamespace(**fields)


def _header(message: Any, frame: str = "frame_id") -> Any:
    """A std_msgs/Header of a message's timestamp and frame, or of a ROS header of another encoding."""
    time = message.stamp if hasattr(message, "stamp") else message.timestamp
    return SimpleNamespace(stamp=_time(time), frame_id=str(getattr(message, frame, "")))


def _time(time: Any) -> Any:
    """A builtin_interfaces/Time; JSON has sec and nsec, protobuf seconds and nanos."""
    for seconds, nanoseconds in (("seconds", "nanos"), ("sec", "nsec"), ("sec", "nanosec"), ("secs", "nsecs")):
        if hasattr(time, nanoseconds):
            sec, nanosec = int(getattr(time, seconds)), int(getattr(time, nanoseconds))
            if abs(sec) >= _MAX_SECONDS or abs(nanosec) >= _MAX_SECONDS:
                raise LogError("its timestamp is damaged (its numbers have more than 32 bits)")
            return SimpleNamespace(sec=sec, nanosec=nanosec)
    raise LogError("its timestamp has no seconds and nanoseconds")


def _bytes(data: Any) -> Array:
    """The bytes of a field, (N,) uint8; base64 in JSON."""
    if isinstance(data, str):
        data = a2b_base64(data, strict_mode=True)
    return np.frombuffer(data, np.uint8) if isinstance(data, bytes) else np.asarray(data, np.uint8)


def _numbers(message: Any, name: str, count: int | None = None) -> Array:
    """The numbers of a field, (N,) float64; zeros if it is empty and has a fixed number of them."""
    numbers = np.array(list(getattr(message, name, ())), np.float64)
    if count is not None and len(numbers) not in (0, count):
        raise LogError(f"its {name} has {len(numbers)} numbers, not {count}")
    return numbers if len(numbers) or count is None else np.zeros(count)


def _image(message: Any) -> Any:
    return SimpleNamespace(
        header=_header(message), width=int(message.width), height=int(message.height), encoding=str(message.encoding),
        step=int(message.step), data=_bytes(message.data), is_bigendian=0,
    )  # fmt: skip


def _encoded(message: Any, format_name: str = "format") -> Any:
    format_of = {format_name: str(message.format)}
    return SimpleNamespace(header=_header(message), data=_bytes(message.data), **format_of)


def _calibration(message: Any) -> Any:
    model = str(message.distortion_model)
    rectified = _numbers(message, "R", 9)
    return SimpleNamespace(
        header=_header(message), width=int(message.width), height=int(message.height), binning_x=0, binning_y=0,
        distortion_model=_DISTORTIONS.get(model, model), d=_numbers(message, "D"), k=_numbers(message, "K", 9),
        r=rectified if rectified.any() else np.eye(3).ravel(), p=_numbers(message, "P", 12),
        roi=SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0, do_rectify=False),
    )  # fmt: skip


def _transforms(messages: Iterable[Any]) -> Any:
    return SimpleNamespace(transforms=[_transform(each) for each in messages])


def _transform(message: Any) -> Any:
    transform = SimpleNamespace(translation=message.translation, rotation=message.rotation)
    header = _header(message, "parent_frame_id")
    return SimpleNamespace(header=header, child_frame_id=str(message.child_frame_id), transform=transform)


def _odometry(message: Any) -> Any:
    pose = SimpleNamespace(pose=message.pose, covariance=_numbers(message, "pose_covariance", 36))
    return SimpleNamespace(header=_header(message), child_frame_id=str(message.body_frame_id), pose=pose)


_ADAPTERS: dict[str, tuple[str, Adapter]] = {
    "RawImage": ("sensor_msgs/msg/Image", _image),
    "CompressedImage": ("sensor_msgs/msg/CompressedImage", _encoded),
    "CompressedVideo": (VIDEO, partial(_encoded, format_name="video_format")),
    "CameraCalibration": ("sensor_msgs/msg/CameraInfo", _calibration),
    "FrameTransforms": ("tf2_msgs/msg/TFMessage", lambda message: _transforms(message.transforms)),
    "FrameTransform": ("tf2_msgs/msg/TFMessage", lambda message: _transforms([message])),
    "PoseInFrame": (
        "geometry_msgs/msg/PoseStamped", lambda message: SimpleNamespace(header=_header(message), pose=message.pose)
    ),
    "Odometry": ("nav_msgs/msg/Odometry", _odometry),
}  # fmt: skip
