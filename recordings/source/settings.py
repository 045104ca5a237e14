"""The settings of a source in a pipeline file: the topics of its streams and their meaning."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from flow.parameters import check_parameters, parameter
from recordings.ros2.from_msg import frame_name
from recordings.ros2.image_from_msg import MAX_PIXELS
from recordings.ros2.tilt_from_msg import AccelerationField, AngleField, PlainAngles

MAX_RATE = 10_000  # Hz; fast inertial sensors have a tenth of it


@dataclass(frozen=True)
class LogSettings:
    """The topics of a log and the meaning of its angles. Topics are found by schema and name unless given.

    Raises
    ------
    ValueError
        If a setting is invalid, or `pitch`, `roll` and `tilt_model` are not given together.
    """

    left: str | None = parameter(None, "topic of the left images")
    right: str | None = parameter(None, "topic of the right images")
    left_info: str | None = parameter(None, "topic of the left camera's CameraInfo")
    right_info: str | None = parameter(None, "topic of the right camera's CameraInfo")
    calibration: str | tuple[str, ...] | None = parameter(
        None, "calibration files instead of CameraInfo, by the working directory: of ROS, Kalibr, EuRoC or OpenCV"
    )
    inclinometer: str | None = parameter(
        None,
        "topic of an Imu or QuaternionStamped; with pitch, roll and tilt_model, or with accelerations, of any message; "
        "with upright_frame, of poses",
    )
    gyroscope: str | None = parameter(
        None, "topic of the Imu with the rates; up is then estimated, even if there is an orientation"
    )
    accelerations: AccelerationField | None = parameter(
        None, "field of the accelerations, for an inclinometer that is no Imu"
    )
    gravity: float | None = parameter(
        None, "magnitude of gravity, for an estimate of up (Mars: 3.71, Moon: 1.62); none: measured",
        unit="m/s^2", low=0.1, high=30.0,
    )  # fmt: skip
    accelerometer_bias: float = parameter(
        0.05, "error of the accelerometer at rest, one sigma of each axis; 0.05 m/s^2 are 0.3 degrees of tilt on Earth",
        unit="m/s^2", low=1e-4, high=5.0,
    )  # fmt: skip
    upright_frame: str | None = parameter(
        None, "frame whose z axis points up, if the tilt is that of poses in it (Odometry, PoseStamped, TFMessage)"
    )
    odometry: str | None = parameter(
        None,
        "topic of an Odometry, PoseStamped, PoseWithCovarianceStamped, or the TFMessage that places base_frame; none: "
        "no pose of the log",
    )
    pitch: AngleField | None = parameter(None, "field of the pitch, for an inclinometer with plain angles")
    roll: AngleField | None = parameter(None, "field of the roll, for an inclinometer with plain angles")
    tilt_model: str | None = parameter(
        None,
        "axis: plain angles are those of the sensor's axes to the horizon; euler: Euler angles",
        choices=("axis", "euler"),
    )
    camera_from_inclinometer: tuple[float, ...] | None = parameter(
        None,
        "quaternion x, y, z, w from inclinometer to left camera (x right, y down, z forward), "
        "for a log without static transforms",
    )
    joints: str | None = parameter(
        None, "YAML file of the axes that move the camera on the rover, whose angles are in a JointState"
    )
    max_pixels: int = parameter(MAX_PIXELS, "pixels of the largest image that is decoded", low=1)
    max_rate: int = parameter(
        MAX_RATE, "messages per second, over ten seconds of log time, of the fastest topic that is read",
        unit="Hz", low=1,
    )  # fmt: skip
    base_frame: str = parameter("base_link", "the rover's frame")

    def __post_init__(self) -> None:
        check_parameters(self)
        object.__setattr__(self, "base_frame", frame_name(self.base_frame))
        if self.upright_frame is not None:
            object.__setattr__(self, "upright_frame", frame_name(self.upright_frame))
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
        model: Any = self.tilt_model
        return PlainAngles(self.pitch, self.roll, model)  # type: ignore[arg-type]  # none of them is None


def _is_unit_quaternion(given: Any) -> bool:
    numbers = isinstance(given, list | tuple) and all(
        isinstance(value, int | float) and not isinstance(value, bool) for value in given
    )
    return numbers and len(given) == 4 and abs(math.hypot(*given) - 1) < 1e-3
