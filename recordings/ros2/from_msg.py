"""Makes our data of ROS 2 messages: images, calibrations, tilts and poses, whatever encoding they came in.

Every function raises LogError, with what is wrong, for a message that does not hold what it should. A tilt is a
direction, never angles: a quaternion turns the world's z axis into the sensor's frame; bare pitch and roll become a
direction by the model that the pipeline file names.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from recordings.errors import LogError
from recordings.ros2.cdr import LAST_STAMP
from recordings.ros2.to_msg import stamp_of
from stages.data import Array, CameraModel, Pose, Tilt, Transform

# Encoding -> (dtype, channels in the message, conversion to gray or RGB)
_PLAIN: dict[str, tuple[str, int, int | None]] = {
    "mono8": ("u1", 1, None),
    "8UC1": ("u1", 1, None),
    "mono16": ("u2", 1, None),
    "16UC1": ("u2", 1, None),
    "rgb8": ("u1", 3, None),
    "bgr8": ("u1", 3, cv2.COLOR_BGR2RGB),
    "8UC3": ("u1", 3, cv2.COLOR_BGR2RGB),  # OpenCV's own name for its own order
    "rgba8": ("u1", 4, cv2.COLOR_RGBA2RGB),
    "bgra8": ("u1", 4, cv2.COLOR_BGRA2RGB),
    "8UC4": ("u1", 4, cv2.COLOR_BGRA2RGB),
    "rgb16": ("u2", 3, None),
    "bgr16": ("u2", 3, cv2.COLOR_BGR2RGB),
}
# OpenCV's short names say what is at (1, 1), ROS names say what is at (0, 0): the long names of OpenCV agree with ROS.
_BAYER = {
    "bayer_rggb": cv2.COLOR_BayerRGGB2RGB,
    "bayer_bggr": cv2.COLOR_BayerBGGR2RGB,
    "bayer_gbrg": cv2.COLOR_BayerGBRG2RGB,
    "bayer_grbg": cv2.COLOR_BayerGRBG2RGB,
}
FARTHEST = 1e9  # m, of a place in any frame
_PADDING = 1024  # bytes that may follow the end of a compressed image
_ENCODINGS = _PLAIN | {f"{name}{bits}": (f"u{bits // 8}", 1, code) for name, code in _BAYER.items() for bits in (8, 16)}


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


def pixels_of(message: Any, size: tuple[int, int] | None = None) -> Array:
    """Gray (H, W) or RGB (H, W, 3) pixels, uint8 or uint16, of a sensor_msgs Image or CompressedImage.

    size: (width, height) of the calibration; an image of another one is refused before it is unpacked.
    """
    return _raw_pixels(message, size) if hasattr(message, "encoding") else _compressed_pixels(message, size)


def unread_encoding(message: Any) -> str:
    """What to say of an Image in an encoding that `pixels_of` does not read; empty for any other message."""
    encoding = getattr(message, "encoding", None)
    if encoding is None or encoding in _ENCODINGS:
        return ""
    return f"image encoding '{encoding}' is not one of those that can be read ({', '.join(_ENCODINGS)})"


def _check_size(width: int, height: int, size: tuple[int, int] | None) -> None:
    if width == 0 or height == 0:
        raise LogError(f"the image is empty ({width}x{height})")
    if size is not None and size != (width, height):
        raise LogError(f"the image is {width}x{height}, its calibration is for {size[0]}x{size[1]}")


def _raw_pixels(message: Any, size: tuple[int, int] | None) -> Array:
    if unread := unread_encoding(message):
        raise LogError(unread)
    kind, channels, conversion = _ENCODINGS[message.encoding]
    height, width, data = int(message.height), int(message.width), np.asarray(message.data, np.uint8)
    row = width * channels * int(kind[1])
    step = int(message.step) or row
    _check_size(width, height, size)
    if step < row:
        raise LogError(f"the image's step of {step} bytes is shorter than a row of {width} {message.encoding} pixels")
    needed = (height - 1) * step + row  # the last row need not be padded
    if data.size < needed:
        raise LogError(f"the image is cut: {data.size} of {needed} bytes are there")
    rows = np.lib.stride_tricks.as_strided(data, (height, row), (step, 1), writeable=False)
    order = ">" if message.is_bigendian else "<"
    pixels = np.ascontiguousarray(rows).view(f"{order}{kind}").astype(kind, copy=False)
    pixels = pixels.reshape((height, width) if channels == 1 else (height, width, channels))
    return _converted(pixels, conversion)


def _compressed_pixels(message: Any, size: tuple[int, int] | None) -> Array:
    data = np.ascontiguousarray(message.data, np.uint8)
    content = data.tobytes()
    # Of a JPEG that lacks a little of its end, OpenCV may say nothing and make a picture that is wrong there, if zeros
    # follow: the rest of a camera's buffer. Behind a whole picture these, or other padding, do no harm.
    end = {b"\xff\xd8": b"\xff\xd9", b"\x89P": b"IEND"}.get(content[:2], b"")
    if end not in content.rstrip(b"\0")[-_PADDING:]:
        raise LogError(f"the compressed image is cut after {data.size} bytes")
    stated = _stated_size(content)
    if stated is not None:
        _check_size(*stated, size)
    encoding = message.format.split(";")[0].strip()
    pixels = unpacked_pixels(data, _BAYER.get(encoding.rstrip("0123456789"))) if stated else None
    if pixels is None:
        raise LogError(f"the compressed image (format '{message.format}') cannot be decoded; it should be JPEG or PNG")
    return pixels


def unpacked_pixels(data: Array, mosaic: int | None = None) -> Array | None:
    """Gray (H, W) or RGB (H, W, 3) pixels, uint8 or uint16, of an image file's bytes (n,); None where OpenCV makes none
    such of them. mosaic: its conversion of a Bayer pattern, where a single channel is one."""
    pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        return None
    if pixels.ndim == 2:
        return _converted(pixels, mosaic)
    return _converted(pixels, cv2.COLOR_BGR2RGB if pixels.shape[2] == 3 else cv2.COLOR_BGRA2RGB)


def _stated_size(content: bytes) -> tuple[int, int] | None:
    """(width, height) as the head of a PNG or JPEG file states it, None where it is neither."""
    if content.startswith(b"\x89PNG") and len(content) >= 24:
        width, height = struct.unpack_from(">II", content, 16)
        return width, height
    position = 2
    while content.startswith(b"\xff\xd8") and position + 9 <= len(content) and content[position] == 0xFF:
        kind, length = content[position + 1], struct.unpack_from(">H", content, position + 2)[0]
        if kind == 0xFF:  # filling before a marker
            position += 1
        elif 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):  # a start of frame; those are tables
            height, width = struct.unpack_from(">HH", content, position + 5)
            return width, height
        else:
            position += 2 + length
    return None


def _converted(pixels: Array, conversion: int | None) -> Array:
    return pixels if conversion is None else np.asarray(cv2.cvtColor(pixels, conversion))


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


def tilt_of(message: Any, log_time: int) -> Tilt:
    """The tilt of a sensor_msgs/Imu, geometry_msgs/QuaternionStamped or Quaternion.

    The quaternion turns the sensor's frame into a world whose z is up (REP 145), so up in the sensor's frame is the
    third row of its matrix.
    """
    if hasattr(message, "orientation_covariance") and message.orientation_covariance[0] == -1:
        raise LogError("the Imu says that it has no orientation (orientation_covariance[0] is -1)")
    quaternion = next((q for name in ("orientation", "quaternion") if (q := getattr(message, name, None))), message)
    up = rotation_of(quaternion, "the inclinometer").as_matrix()[2]
    return _tilt(message, log_time, up)


def _tilt(message: Any, log_time: int, up: Array) -> Tilt:
    header = getattr(message, "header", None)
    stamp = stamp_or(header, log_time) if header is not None else log_time
    return Tilt(stamp, up / np.linalg.norm(up), frame_of(message) or "inclinometer")


@dataclass(frozen=True)
class Angle:
    """Where an angle stands in a message and what it means: field path ("vector.x"), unit, and sign (+1 or -1)."""

    field: str
    unit: Literal["deg", "rad"]
    sign: int

    def __call__(self, message: Any) -> float:
        """The angle in radians, in our sense of sign."""
        value = self.number(message)
        if not np.isfinite(value):
            raise LogError(f"field '{self.field}' holds {value}, which is not an angle")
        return self.sign * float(np.deg2rad(value) if self.unit == "deg" else value)

    def number(self, message: Any) -> float:
        """What the field holds, a number, NaN perhaps. Raises LogError where the message's type has no such field."""
        value: Any = message
        for name in self.field.split("."):
            names = list(getattr(value, "__dataclass_fields__", ()))
            if name not in names:
                known = ", ".join(known for known in names if not known.startswith("_"))
                where = f"{_kind(value)} (it has {known})" if known else _kind(value)
                raise LogError(f"the message has no field '{self.field}': no '{name}' in its {where}")
            value = getattr(value, name)
        if isinstance(value, bool) or not isinstance(value, int | float | np.number):
            raise LogError(f"field '{self.field}' holds a {_kind(value)}, which is not an angle")
        return float(value)


def _kind(value: Any) -> str:
    """The type of what a message holds: a message's own, or that of a number or a text."""
    return str(getattr(value, "__msgtype__", type(value).__name__))


@dataclass(frozen=True)
class Angles:
    """How bare pitch and roll make a direction, in a sensor frame x forward, y left, z up.

    A positive pitch has the nose up, a positive roll the left side up (both after `sign`). model "axis": the angles of
    the x and the y axis to the horizon, what an inclinometer measures. model "euler": pitch is that of the x axis, roll
    turns about the pitched x axis.
    """

    pitch: Angle
    roll: Angle
    model: Literal["axis", "euler"]

    def check(self, message: Any) -> None:
        """Raise LogError where the message has no numbers in the two fields."""
        self.pitch.number(message)
        self.roll.number(message)

    def __call__(self, message: Any, log_time: int) -> Tilt:
        """The tilt that a message's two angles tell."""
        return _tilt(message, log_time, up_of(self.pitch(message), self.roll(message), self.model))


def up_of(pitch: float, roll: float, model: Literal["axis", "euler"]) -> Array:
    """The unit vector up, in x forward, y left, z up, of a pitch (nose up) and a roll (left side up), rad."""
    for name, angle in (("pitch", pitch), ("roll", roll)):
        if not abs(angle) <= np.pi / 2:
            raise LogError(f"a {name} of {np.rad2deg(angle):.1f} degrees is no tilt; check the field and its unit")
    if model == "euler":
        return np.array([np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)])
    forward, left = np.sin(pitch), np.sin(roll)
    rest = 1 - forward * forward - left * left
    if rest < 0:
        angles = f"pitch {np.rad2deg(pitch):.1f} and roll {np.rad2deg(roll):.1f} degrees"
        raise LogError(
            f"{angles} cannot both be angles of perpendicular axes to the horizon; check unit and tilt_model"
        )
    return np.array([forward, left, np.sqrt(rest)])
