"""What discovery is about: topics, the roles that they can have, and what is missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from recordings.video.formats import VIDEO

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", VIDEO)  # the best first
INFO = "sensor_msgs/msg/CameraInfo"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
IMU = "sensor_msgs/msg/Imu"
TILTS = (IMU, "geometry_msgs/msg/QuaternionStamped", "geometry_msgs/msg/Quaternion")
BARE_TILT = "geometry_msgs/msg/Vector3Stamped"
ODOMETRY = "nav_msgs/msg/Odometry"
POSES = (ODOMETRY, "geometry_msgs/msg/PoseWithCovarianceStamped", "geometry_msgs/msg/PoseStamped")
RESULTS = "/nav/"  # results of an earlier run; a pose there is used only if a setting names it


@dataclass(frozen=True)
class Topic:
    """A topic that can be decoded. schema: full ROS 2 name; messages: their number."""

    name: str
    schema: str
    messages: int


class TiltKind(StrEnum):
    """What a tilt is made of."""

    ORIENTATION = "orientation"
    ANGLES = "bare angles"
    ACCELERATIONS = "accelerations"  # each by itself, as of an inclinometer
    ESTIMATE = "estimate"  # from accelerations and rates
    POSE = "pose"


@dataclass(frozen=True)
class Remedy:
    """Settings of the source that supply a missing stream. condition: what the user has to know or to fill in."""

    settings: dict[str, Any]
    condition: str = ""


@dataclass
class DiscoveredTopics:
    """chosen: role (left, right, left_info, right_info, inclinometer, gyroscope, odometry) -> topic; why: stream -> why
    its topic; tilt: what the messages of the inclinometer are; missing: stream -> reason and remedy; remedies: stream
    -> settings, any of which would supply it; refused: setting that names a topic the log does not have -> reason."""

    chosen: dict[str, str] = field(default_factory=dict)
    why: dict[str, str] = field(default_factory=dict)
    tilt: TiltKind = TiltKind.ORIENTATION
    missing: dict[str, str] = field(default_factory=dict)
    remedies: dict[str, list[Remedy]] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)

    def refuse(self, stream: str, setting: str, why: str) -> None:
        """Note that a stream is missing because of a user's setting; nothing replaces it."""
        self.missing[stream] = self.refused[setting] = why

    def refuse_topic(self, stream: str, setting: str, given: str, kind: str, topics: Sequence[Topic]) -> None:
        """The same of a setting whose topic, `given`, is none of those that it could have. kind: of these, in words."""
        none = f"it has no {kind} topic that can be decoded"
        listed = f"its {kind} topics are {names_of(topics)}" if topics else none
        why = f"the source's '{setting}' is set to {given}, which is not a suitable topic of the log ({listed})"
        self.refuse(stream, setting, why)

    def offer(self, stream: str, setting: str, topics: Sequence[str], condition: str = "") -> None:
        """Note the topics that a setting could have."""
        self.remedies.setdefault(stream, []).extend(Remedy({setting: topic}, condition) for topic in topics)


def names_of(topics: Sequence[Topic]) -> str:
    return ", ".join(topic.name for topic in topics)
