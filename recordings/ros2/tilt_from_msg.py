"""Tilts from ROS 2 messages.

A tilt is a direction, never angles. A quaternion turns the world's z axis into the sensor's frame; plain pitch and roll
become a direction by the model in the pipeline file.
"""

from __future__ import annotations

from dataclasses import MISSING, dataclass
from typing import Any, Literal

import numpy as np

from flow.parameters import check_parameters, parameter
from recordings.errors import LogError
from recordings.ros2.from_msg import frame_of, rotation_of, stamp_or
from stages.data import Array, Tilt

MAX_STATED_SIGMA = np.radians(20.0)  # beyond it a covariance says only that the driver does not know


def tilt_of(message: Any, log_time: int) -> Tilt:
    """The tilt of a sensor_msgs/Imu, geometry_msgs/QuaternionStamped or Quaternion.

    The quaternion turns the sensor's frame into a world with z up (REP 145), so up in the sensor's frame is the third
    row of its matrix. The sigma is that of the Imu's orientation_covariance, without the heading's.
    """
    covariance = getattr(message, "orientation_covariance", None)
    if covariance is not None and covariance[0] == -1:
        raise LogError("the Imu marks its orientation as absent (orientation_covariance[0] is -1)")
    quaternion = next((q for name in ("orientation", "quaternion") if (q := getattr(message, name, None))), message)
    up = rotation_of(quaternion, "the inclinometer").as_matrix()[2]
    return _tilt(message, log_time, up, None if covariance is None else _stated_sigma(covariance))


def _tilt(message: Any, log_time: int, up: Array, sigma: float | None = None) -> Tilt:
    header = getattr(message, "header", None)
    stamp = stamp_or(header, log_time) if header is not None else log_time
    return Tilt(stamp, up / np.linalg.norm(up), frame_of(message) or "inclinometer", sigma)


def _stated_sigma(covariance: Array) -> float | None:
    """Standard deviation, rad, about the two axes that are surer than the third, which is the heading's; None for zeros
    (unknown) and for what is no covariance of a tilt."""
    matrix = np.asarray(covariance, np.float64).reshape(3, 3)
    if not np.isfinite(matrix).all():
        return None
    variance = float(np.mean(np.linalg.eigvalsh((matrix + matrix.T) / 2)[:2]))
    return float(np.sqrt(variance)) if 0 < variance < MAX_STATED_SIGMA**2 else None


@dataclass(frozen=True)
class AngleField:
    """An angle in a message: the path of its field, its unit and its sign."""

    field: str = parameter(MISSING, "path of the field in the message, such as vector.x")
    unit: str = parameter(MISSING, "unit of its numbers", choices=("deg", "rad"))
    sign: int = parameter(MISSING, "1: positive is nose up (pitch) or left side up (roll)", choices=(1, -1))

    def __post_init__(self) -> None:
        check_parameters(self)

    def __call__(self, message: Any) -> float:
        """The angle in radians, with our sign."""
        value = self.number(message)
        if not np.isfinite(value):
            raise LogError(f"field '{self.field}' contains {value}, which is not an angle")
        return self.sign * float(np.deg2rad(value) if self.unit == "deg" else value)

    def number(self, message: Any) -> float:
        """The number in the field, maybe NaN. Raises LogError if the message has no such field."""
        value: Any = message
        for name in self.field.split("."):
            names = list(getattr(value, "__dataclass_fields__", ()))
            if name not in names:
                known = ", ".join(known for known in names if not known.startswith("_"))
                where = f"{_kind(value)} (it has {known})" if known else _kind(value)
                raise LogError(f"the message has no field '{self.field}': no '{name}' in its {where}")
            value = getattr(value, name)
        if isinstance(value, bool) or not isinstance(value, int | float | np.number):
            raise LogError(f"field '{self.field}' contains a {_kind(value)}, which is not an angle")
        return float(value)


def _kind(value: Any) -> str:
    """The name of a value's type."""
    return str(getattr(value, "__msgtype__", type(value).__name__))


@dataclass(frozen=True)
class PlainAngles:
    """Converts plain pitch and roll to a direction in a sensor frame x forward, y left, z up.

    A positive pitch is nose up, a positive roll left side up (both after `sign`). model "axis": angles of the x and y
    axis to the horizon, as an inclinometer measures. model "euler": pitch of the x axis, roll about the pitched x axis.
    """

    pitch: AngleField
    roll: AngleField
    model: Literal["axis", "euler"]

    def check(self, message: Any) -> None:
        """Raise LogError if a field is not a number."""
        self.pitch.number(message)
        self.roll.number(message)

    def __call__(self, message: Any, log_time: int) -> Tilt:
        """The tilt by the two angles of a message."""
        return _tilt(message, log_time, up_of(self.pitch(message), self.roll(message), self.model))


def up_of(pitch: float, roll: float, model: Literal["axis", "euler"]) -> Array:
    """The unit vector up in x forward, y left, z up, from pitch (nose up) and roll (left side up), rad."""
    for name, angle in (("pitch", pitch), ("roll", roll)):
        if not abs(angle) <= np.pi / 2:
            raise LogError(
                f"a {name} of {np.rad2deg(angle):.1f} degrees is outside -90 to 90; check the field and its unit"
            )
    if model == "euler":
        return np.array([np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)])
    forward, left = np.sin(pitch), np.sin(roll)
    rest = 1 - forward * forward - left * left
    if rest < 0:
        angles = f"pitch {np.rad2deg(pitch):.1f} and roll {np.rad2deg(roll):.1f} degrees"
        raise LogError(
            f"{angles} contradict each other as angles of perpendicular axes to the horizon; check unit and tilt_model"
        )
    return np.array([forward, left, np.sqrt(rest)])
