"""The settings of a source in a pipeline file: the topics of its streams and their meaning."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flow.parameters import Checked, check_parameters, parameter
from recordings.ros2.from_msg import frame_name
from recordings.ros2.image_from_msg import MAX_PIXELS
from recordings.ros2.tilt_from_msg import AccelerationField, AngleField, BareAngles

MAX_RATE = 10_000  # Hz; fast inertial sensors have a tenth of it


@dataclass(frozen=True)
class TimeOffsets(Checked):
    """Times that are added to the stamps of streams, so that they fit those of the left images."""

    right: int = parameter(0, "time added to the stamps of the right images", unit="ns")
    inclinometer: int = parameter(0, "time added to the stamps of the tilts, negative if they are late", unit="ns")
    odometry: int = parameter(0, "time added to the stamps of the poses, negative if they are late", unit="ns")
    gyroscope: int = parameter(
        0, "time added to the stamps of angular rates on a topic of their own, so that they fit the accelerations",
        unit="ns",
    )  # fmt: skip


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
        None, "calibration files instead of CameraInfo, of ROS, Kalibr, EuRoC or OpenCV; relative to the working folder"
    )
    inclinometer: str | None = parameter(
        None,
        "topic of the tilt: an Imu or QuaternionStamped; any message if pitch, roll and tilt_model, or accelerations, "
        "are set; poses if upright_frame is set",
    )
    gyroscope: str | None = parameter(
        None, "topic of an Imu with angular rates; the tilt is then estimated, even if there is an orientation"
    )
    accelerations: AccelerationField | None = parameter(
        None, "field of the accelerations, for an inclinometer that is not an Imu, or an Imu that has them negated"
    )
    gravity: float | None = parameter(
        None, "magnitude of gravity, for an estimated tilt (Mars: 3.71, Moon: 1.62); none: measured",
        unit="m/s^2", low=0.1, high=30.0,
    )  # fmt: skip
    accelerometer_bias: float = parameter(
        0.05, "bias of the accelerometer, one sigma of each axis; 0.05 m/s^2 are 0.3 degrees of tilt on Earth",
        unit="m/s^2", low=1e-4, high=5.0,
    )  # fmt: skip
    upright_frame: str | None = parameter(
        None, "frame of poses, with z up, if the tilt is taken from them (Odometry, PoseStamped, TFMessage)"
    )
    odometry: str | None = parameter(
        None,
        "topic of the pose: an Odometry, PoseStamped, PoseWithCovarianceStamped, or the TFMessage with base_frame; "
        "visual: visual odometry in place of it",
    )
    pitch: AngleField | None = parameter(None, "field of the pitch, for an inclinometer with bare angles")
    roll: AngleField | None = parameter(None, "field of the roll, for an inclinometer with bare angles")
    tilt_model: str | None = parameter(
        None,
        "meaning of bare angles; axis: angles of the sensor's axes to the horizon; euler: Euler angles",
        choices=("axis", "euler"),
    )
    camera_from_inclinometer: tuple[float, ...] | None = parameter(
        None,
        "quaternion x, y, z, w from inclinometer to rectified left camera (x right, y down, z forward), "
        "for a log without static transforms",
    )
    joints: str | None = parameter(
        None, "YAML file of the joints that move the camera on the rover; a JointState has their angles"
    )
    time_offset: TimeOffsets | None = parameter(None, "times added to the stamps of other streams than the left images")
    max_pixels: int = parameter(MAX_PIXELS, "largest number of pixels of an image", low=1)
    max_rate: int = parameter(
        MAX_RATE, "highest message rate of a topic, over ten seconds of log time",
        unit="Hz", low=1,
    )  # fmt: skip
    base_frame: str = parameter("base_link", "the rover's frame")

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that the settings name: calibrations and joints."""
        calibration = (self.calibration,) if isinstance(self.calibration, str) else self.calibration or ()
        return tuple(map(Path, filter(None, (*calibration, self.joints))))

    def __post_init__(self) -> None:
        check_parameters(self)
        for name, kind in (("pitch", AngleField), ("roll", AngleField), ("time_offset", TimeOffsets)):
            if not isinstance(getattr(self, name), kind | None):
                raise ValueError(f"McapSource.{name} must be of {kind.__name__}, not {getattr(self, name)!r}")
        object.__setattr__(self, "base_frame", frame_name(self.base_frame))
        if self.upright_frame is not None:
            object.__setattr__(self, "upright_frame", frame_name(self.upright_frame))
        self.angles()
        given = self.camera_from_inclinometer
        if given is not None and not _is_unit_quaternion(given):
            raise ValueError(f"McapSource.camera_from_inclinometer must be a unit quaternion x, y, z, w, not {given!r}")

    def offset_of(self, stream: str) -> int:
        """The time that is added to the stamps of a stream, or of the gyroscope, ns."""
        offset: int = getattr(self.time_offset, stream, 0)
        return offset

    def angles(self) -> BareAngles | None:
        """The meaning of bare angles; None if not set. Raises ValueError if only a part is set."""
        given = {"pitch": self.pitch, "roll": self.roll, "tilt_model": self.tilt_model}
        if not any(value is not None for value in given.values()):
            return None
        for name, value in given.items():
            if value is None:
                raise ValueError(f"McapSource needs '{name}': bare angles need pitch, roll and tilt_model")
        if (self.pitch.topic is None) != (self.roll.topic is None):  # type: ignore[union-attr]
            raise ValueError(
                "McapSource needs 'pitch.topic' and 'roll.topic', or neither if one message has both angles"
            )
        if self.pitch.topic is not None and self.inclinometer not in (None, self.pitch.topic):  # type: ignore[union-attr]
            raise ValueError("McapSource needs either 'inclinometer', or 'pitch.topic' and 'roll.topic'")
        model: Any = self.tilt_model
        return BareAngles(self.pitch, self.roll, model)  # type: ignore[arg-type]  # none of them is None


def _is_unit_quaternion(given: Any) -> bool:
    numbers = isinstance(given, list | tuple) and all(
        isinstance(value, int | float) and not isinstance(value, bool) for value in given
    )
    return numbers and len(given) == 4 and abs(math.hypot(*given) - 1) < 1e-3
