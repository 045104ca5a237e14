"""The settings of a source in a pipeline file: the topics of its streams and their meaning."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from recordings.ros2.from_msg import frame_name
from recordings.ros2.tilt_from_msg import AngleField, PlainAngles


@dataclass(frozen=True)
class LogSettings:
    """The topics of a log and the meaning of its angles. Topics are found by schema and name unless given.

    Parameters
    ----------
    left, right : str, optional
        Image topics.
    left_info, right_info : str, optional
        Their CameraInfo topics.
    inclinometer : str, optional
        Topic of an Imu or QuaternionStamped; with `pitch`, `roll` and `tilt_model`, of any message.
    odometry : str, optional
        Topic of an Odometry, PoseStamped, PoseWithCovarianceStamped, or the TFMessage that places `base_frame`.
    pitch, roll : mapping, optional
        The fields of an inclinometer with plain angles, {field: vector.x, unit: deg | rad, sign: 1 | -1} each. Its
        frame is x forward, y left, z up. With sign 1 a positive pitch is nose up, a positive roll left side up.
    tilt_model : str, optional
        "axis": the angles of the sensor's axes to the horizon. "euler": Euler angles.
    camera_from_inclinometer : tuple of float, optional
        Quaternion x, y, z, w from inclinometer to left camera (x right, y down, z forward), for a log without
        static transforms.
    base_frame : str
        The rover's frame.

    Raises
    ------
    ValueError
        If a setting is invalid, or `pitch`, `roll` and `tilt_model` are not given together.
    """

    left: str | None = None
    right: str | None = None
    left_info: str | None = None
    right_info: str | None = None
    inclinometer: str | None = None
    odometry: str | None = None
    pitch: Mapping[str, Any] | None = None
    roll: Mapping[str, Any] | None = None
    tilt_model: str | None = None
    camera_from_inclinometer: tuple[float, ...] | None = None
    base_frame: str = "base_link"

    def __post_init__(self) -> None:
        object.__setattr__(self, "base_frame", frame_name(self.base_frame))
        self.angles()
        given = self.camera_from_inclinometer
        if given is not None and not _is_unit_quaternion(given):
            raise ValueError(f"McapSource.camera_from_inclinometer must be a unit quaternion x, y, z, w, not {given!r}")

    def angles(self) -> PlainAngles | None:
        """The meaning of plain angles; None if not set. Raises ValueError if only a part is set."""
        given = {"pitch": self.pitch, "roll": self.roll, "tilt_model": self.tilt_model}
        if not any(value is not None for value in given.values()):
            return None
        for name, value in given.items():
            if value is None:
                raise ValueError(f"McapSource needs '{name}': plain angles need pitch, roll and tilt_model")
        if self.tilt_model not in ("axis", "euler"):
            raise ValueError(f"McapSource.tilt_model must be axis or euler, not {self.tilt_model}")
        model: Any = self.tilt_model
        return PlainAngles(_angle("pitch", self.pitch), _angle("roll", self.roll), model)


def _is_unit_quaternion(given: Any) -> bool:
    numbers = isinstance(given, list | tuple) and all(
        isinstance(value, int | float) and not isinstance(value, bool) for value in given
    )
    return numbers and len(given) == 4 and abs(math.hypot(*given) - 1) < 1e-3


def _angle(name: str, given: Any) -> AngleField:
    if not isinstance(given, Mapping):
        raise ValueError(f"McapSource.{name} must be a mapping of field, unit and sign, not {given!r}")
    valid: dict[str, tuple[Any, ...]] = {"field": (), "unit": ("deg", "rad"), "sign": (1, -1)}
    for key in given:
        if key not in valid:
            raise ValueError(f"McapSource.{name} has no '{key}'; it has field, unit and sign")
    for key, choices in valid.items():
        if key not in given:
            raise ValueError(
                f"McapSource.{name} lacks '{key}'" + (f" ({' or '.join(map(str, choices))})" if choices else "")
            )
        if choices and given[key] not in choices:
            raise ValueError(f"McapSource.{name}.{key} must be {' or '.join(map(str, choices))}, not {given[key]!r}")
    return AngleField(str(given["field"]), given["unit"], int(given["sign"]))
