"""Tilts from ROS 2 messages, and the accelerations and rates to estimate them from.

A tilt is a direction, never angles. A quaternion turns the world's z axis into the sensor's frame; bare pitch and roll
become a direction by the model in the pipeline file; accelerations at rest are the direction.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, replace
from functools import lru_cache
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np

from flow.contracts import counted
from flow.parameters import Checked, check_parameters, parameter
from recordings.containers.time_range import MAX_LATENESS_NS
from recordings.errors import LogError
from recordings.inertial.blocks import InertialSample
from recordings.ros2.from_msg import frame_of, pose_of, stamp_or, unit_quaternion
from stages.data import Array, Tilt

Vector = tuple[float, float, float]

MIN_ACCELERATION = 0.1  # m/s^2; less contains no gravity
MAX_STATED_SIGMA = math.pi / 2  # rad, of an unknown direction, for which drivers state 1e6 rad^2
MAX_WAITING_ROLLS = 1000  # that no pitch follows
_MAX_PLACES = 100  # of an array of numbers, that a field may be


def tilt_of(message: Any, log_time: int) -> Tilt:
    """The tilt of a sensor_msgs/Imu, geometry_msgs/QuaternionStamped or Quaternion.

    The quaternion turns the sensor's frame into a world with z up (REP 145), so up in the sensor's frame is the third
    row of its matrix. The sigma is that of the Imu's orientation_covariance, without the heading's.
    """
    covariance = getattr(message, "orientation_covariance", None)
    if covariance is not None and covariance[0] == -1:
        raise LogError("the Imu marks its orientation as absent (orientation_covariance[0] is -1)")
    quaternion = next((q for name in ("orientation", "quaternion") if (q := getattr(message, name, None))), message)
    x, y, z, w = unit_quaternion(quaternion, "the inclinometer")
    up = np.array([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)])
    return _tilt(message, log_time, up, None if covariance is None else _stated_sigma(covariance))


def tilt_of_acceleration(message: Any, log_time: int, acceleration: Vector | None) -> Tilt:
    """The tilt by an acceleration of that message, m/s^2, if it is that of gravity alone."""
    if acceleration is None or not np.linalg.norm(acceleration) > MIN_ACCELERATION:
        raise LogError(f"the acceleration {acceleration} contains no gravity")
    return _tilt(message, log_time, np.array(acceleration))


def tilt_of_pose(message: Any, log_time: int, upright: str, base_frame: str) -> Tilt | None:
    """The tilt by a pose in the frame `upright`, whose z axis points up; None where a TFMessage has none.

    The messages are those of `pose_of`. The sigma is that of the covariance of roll and pitch.
    """
    pose = pose_of(message, log_time, base_frame)
    if pose is None:
        return None
    if pose.frame_id != upright:
        raise LogError(f"its frame is '{pose.frame_id}', but 'upright_frame' of the source is '{upright}'")
    sigma = None if pose.covariance is None else _stated_sigma(pose.covariance[3:, 3:])
    return Tilt(pose.stamp, pose.transform.rotation[2], pose.child_frame_id, sigma)


def sample_of(message: Any, log_time: int, acceleration: Vector | None, rate: Vector | None) -> InertialSample:
    """An acceleration, m/s^2, and a rate, rad/s, of that message, with its stamp."""
    return InertialSample(_stamp_of(message, log_time), rate, acceleration)


def acceleration_of(message: Any) -> Vector | None:
    """The accelerations of a sensor_msgs/Imu; None if it marks them as absent."""
    return _measured(message, "linear_acceleration")


def rate_of(message: Any) -> Vector | None:
    """The rates of a sensor_msgs/Imu; None if it marks them as absent."""
    return _measured(message, "angular_velocity")


def _measured(message: Any, name: str) -> Vector | None:
    covariance = getattr(message, f"{name}_covariance", None)
    if covariance is not None and len(covariance) and covariance[0] == -1:
        return None
    vector = getattr(message, name)
    return _finite_vector([vector.x, vector.y, vector.z], name)


def _finite_vector(values: list[Any], name: str) -> Vector:
    x, y, z = (float(value) for value in values)
    if not abs(x) + abs(y) + abs(z) < np.inf:  # or NaN
        raise LogError(f"'{name}' contains {[x, y, z]}")
    return x, y, z


def _tilt(message: Any, log_time: int, up: Array, sigma: float | None = None) -> Tilt:
    return Tilt(_stamp_of(message, log_time), up / math.hypot(*up), frame_of(message) or "inclinometer", sigma)


def _stamp_of(message: Any, log_time: int) -> int:
    """The stamp of a message, ns; of one without a header the log time."""
    header = getattr(message, "header", None)
    return stamp_or(header, log_time) if header is not None else log_time


def _stated_sigma(covariance: Array) -> float | None:
    """Standard deviation, rad, about the two level axes; None for zeros (unknown) and for what is no covariance.

    A covariance of rotations is about the fixed axes of the upright frame (REP 103), so the third is the heading's.
    """
    return _sigma_of(np.asarray(covariance, np.float64).tobytes())


@lru_cache(maxsize=64)
def _sigma_of(covariance: bytes) -> float | None:
    """The same from the bytes of 9 float64, which most logs repeat in every message."""
    x, y, _ = np.frombuffer(covariance)[::4].tolist()
    variance = (x + y) / 2
    return min(math.sqrt(variance), MAX_STATED_SIGMA) if min(x, y) >= 0 and 0 < variance < math.inf else None


@dataclass(frozen=True)
class AngleField(Checked):
    """An angle in a message: the path of its field, its unit and its sign."""

    field: str = parameter(MISSING, "path of the field in the message, such as vector.x")
    unit: str = parameter(MISSING, "unit of its numbers", choices=("deg", "rad"))
    sign: int = parameter(MISSING, "1: positive is nose up (pitch) or left side up (roll)", choices=(1, -1))
    topic: str | None = parameter(None, "topic of the message, where pitch and roll are on two; none: inclinometer")

    def check(self, message: Any) -> None:
        """Raise LogError if the field is not a number."""
        _number(message, self.field)

    def __call__(self, message: Any) -> float:
        """The angle in radians, with our sign."""
        value = _number(message, self.field)
        if not np.isfinite(value):
            raise LogError(f"field '{self.field}' contains {value}, which is not an angle")
        return self.sign * float(np.deg2rad(value) if self.unit == "deg" else value)


@dataclass(frozen=True)
class AccelerationField:
    """Three accelerations in a message."""

    field: str = parameter(MISSING, "path of the field with x, y and z, such as vector, or the paths of three numbers")
    sign: int = parameter(1, "1: at rest the acceleration points up, as from an Imu; -1: down", choices=(1, -1))

    def __post_init__(self) -> None:
        check_parameters(self)
        if len(self.field.split()) not in (1, 3):
            raise ValueError(f"AccelerationField.field must be one path or three, not '{self.field}'")

    def __call__(self, message: Any) -> Vector:
        """The acceleration, up at rest."""
        paths = self.field.split()
        paths = [f"{self.field}.{axis}" for axis in "xyz"] if len(paths) == 1 else paths
        return _finite_vector([self.sign * _number(message, path) for path in paths], self.field)


def _number(message: Any, path: str) -> float:
    """The number in a field of a message, maybe NaN. Raises LogError if there is none."""
    value = message
    for name in path.split("."):
        names = _field_names(value)
        if name not in names:
            known = ", ".join(known for known in names if not known.startswith("_"))
            where = f"{_kind(value)} (it has {known})" if known else _kind(value)
            raise LogError(f"the message has no field '{path}': no '{name}' in its {where}")
        value = value[int(name)] if _is_array(value) else getattr(value, name)
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise LogError(f"field '{path}' contains a {_kind(value)}, which is not a number")
    return float(value)


def _field_names(value: Any) -> list[str]:
    """The names of a message's fields, in any encoding; of an array the places of its numbers."""
    if hasattr(value, "DESCRIPTOR"):  # protobuf
        return [known.name for known in value.DESCRIPTOR.fields]
    if _is_array(value):
        return [str(place) for place in range(min(len(value), _MAX_PLACES))]
    names: list[str] = [*(getattr(value, "__dataclass_fields__", None) or getattr(value, "__dict__", {}))]
    return names


def _is_array(value: Any) -> bool:
    return isinstance(value, Sequence | np.ndarray) and not isinstance(value, str)


def _kind(value: Any) -> str:
    """The name of a value's type."""
    name = "JSON object" if isinstance(value, SimpleNamespace) else type(value).__name__
    return str(getattr(value, "__msgtype__", name))


@dataclass(frozen=True)
class BareAngles:
    """Converts bare pitch and roll to a direction in a sensor frame x forward, y left, z up.

    A positive pitch is nose up, a positive roll left side up (both after `sign`). model "axis": angles of the x and y
    axis to the horizon, as an inclinometer measures. model "euler": pitch of the x axis, roll about the pitched x axis.
    """

    pitch: AngleField
    roll: AngleField
    model: Literal["axis", "euler"]

    def __call__(self, message: Any, log_time: int) -> Tilt:
        """The tilt by the two angles of a message."""
        return _tilt(message, log_time, up_of(self.pitch(message), self.roll(message), self.model))


class JoinedAngles:
    """Converts pitch and roll of two topics to a direction at the stamps of rolls, with the pitch interpolated."""

    def __init__(self, angles: BareAngles) -> None:
        self._angles = angles
        self._pitch: tuple[int, float] | None = None  # the last one, with its stamp
        self._rolls = deque[tuple[Any, int]]()  # later than it, with their log times

    def add_roll(self, message: Any, log_time: int) -> None:
        """Keep a roll until the next pitch. Raises LogError for rolls that no pitch has followed for 3 s."""
        self._angles.roll(message)  # raises LogError
        self._rolls.append((message, log_time))
        count, since = len(self._rolls), self._rolls[0][1]
        if log_time - since > MAX_LATENESS_NS or count > MAX_WAITING_ROLLS:
            self._rolls.clear()
            raise LogError(f"no pitch follows the last {counted(count, 'roll')}, since {since} ns")

    def add_pitch(self, message: Any, log_time: int) -> Tilt | None:
        """The tilt at the last roll between the pitch before and this one; None if there is none."""
        end, after = _stamp_of(message, log_time), self._angles.pitch(message)
        begin, before = self._pitch or (end, after)
        self._pitch, found = (end, after), None
        while self._rolls and _stamp_of(*self._rolls[0]) <= end:
            found = self._rolls.popleft()
        if found is None or (stamp := _stamp_of(*found)) < begin:
            return None
        pitch = after if stamp == end else before + (after - before) * (stamp - begin) / (end - begin)
        tilt = _tilt(*found, up_of(pitch, self._angles.roll(found[0]), self._angles.model))
        return tilt if frame_of(found[0]) else replace(tilt, frame_id=frame_of(message) or tilt.frame_id)


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
