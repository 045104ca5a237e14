"""Replays an MCAP log as the streams that a pipeline starts from: two cameras, tilt, mount and pose.

Opening a log looks at its topics, its calibration and its static transforms, and says for each stream that it cannot
give why not; reading it then decodes only what was chosen. What is broken is delivered as an exception in its place.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar

import numpy as np

from recordings.decode import Angle, Angles, pixels_of, pose_of, stamp_or, tilt_of
from recordings.discovery import IMAGES, IMU, TRANSFORMS, Topic, Topics, discover
from recordings.errors import LogError
from recordings.mcap_index import Lost, said
from recordings.mcap_reader import McapFile
from recordings.rig import Camera, Frames, calibrated_pair, mounted
from recordings.ros2_types import decoder_for, full_name
from stages.data import CameraImage, Mount, Pose, Tilt

LEAD = 1_000_000_000  # ns; tilt and pose are read this much beyond the ends of a range, to interpolate at its frames
CAMERAS = ("left", "right")
_CALIBRATION = ("width", "height", "k", "d", "r", "p", "distortion_model")


@dataclass(frozen=True)
class McapSource:
    """Where the streams of a log are. Topic names are found by schema and name unless given.

    left, right: image topics; left_info, right_info: their CameraInfo; inclinometer: Imu, QuaternionStamped, or with
    the angle settings any message; odometry: Odometry, PoseStamped, PoseWithCovarianceStamped.

    pitch, roll: for an inclinometer that gives bare angles, {field: vector.x, unit: deg | rad, sign: 1 | -1} each, and
    tilt_model: "axis" (angles of its axes to the horizon) or "euler"; its frame is x forward, y left, z up, and with
    sign 1 a positive pitch has the nose up, a positive roll the left side up.

    camera_from_inclinometer: quaternion x, y, z, w from inclinometer to left camera (x right, y down, z forward), for a
    log without static transforms. base_frame: the rover's frame.
    """

    streams: ClassVar[Mapping[str, type]] = {
        "left": CameraImage,
        "right": CameraImage,
        "inclinometer": Tilt,
        "mount": Mount,
        "odometry": Pose,
    }

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
        self.angles()
        given = self.camera_from_inclinometer
        if given is not None and (len(given) != 4 or not abs(float(np.linalg.norm(given)) - 1) < 1e-3):
            raise ValueError(f"McapSource.camera_from_inclinometer must be a unit quaternion x, y, z, w, not {given}")

    def angles(self) -> Angles | None:
        """How bare angles are read; None where the settings do not speak of them. Raises ValueError for half of it."""
        given = {"pitch": self.pitch, "roll": self.roll, "tilt_model": self.tilt_model}
        if not any(value is not None for value in given.values()):
            return None
        for name, value in given.items():
            if value is None:
                raise ValueError(
                    f"McapSource needs '{name}' as well: bare angles are given by pitch, roll and tilt_model"
                )
        if self.tilt_model not in ("axis", "euler"):
            raise ValueError(f"McapSource.tilt_model must be axis or euler, not {self.tilt_model}")
        model: Any = self.tilt_model
        return Angles(_angle("pitch", self.pitch), _angle("roll", self.roll), model)

    def open(self, path: Path, start: float | None = None, end: float | None = None) -> McapLog:
        """The log at `path`, from `start` to before `end` (seconds after its first message).

        Raises LogError where it cannot be read at all; what it lacks is told by its `missing`.
        """
        return McapLog(Path(path), self, start, end)


def _angle(name: str, given: Any) -> Angle:
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
    return Angle(str(given["field"]), given["unit"], int(given["sign"]))


@dataclass
class Reading:
    """One topic as it is read: the stream it makes, its channels, its decoders by channel, and what makes an item."""

    stream: str
    topic: str
    decoders: dict[int, Callable[[bytes | memoryview], Any]]
    item: Callable[[Any, int], Any]


class Unchanged:
    """Looks through the calibrations of a camera: makes nothing of them, and raises at the first that differs."""

    def __init__(self, first: Any) -> None:
        self._first, self._told = first, False

    def __call__(self, message: Any, log_time: int) -> None:
        """Raises LogError, once, if `message` is another calibration than the first."""
        same = all(np.array_equal(getattr(message, name), getattr(self._first, name)) for name in _CALIBRATION)
        if not same and not self._told:
            self._told = True
            raise LogError("the calibration changes here, but images are read with the first; cut the log in two here")


@dataclass
class McapLog:
    """An opened log; iterating gives (log time in ns, stream, item), an exception as item standing for a loss.

    missing: stream -> why the log does not provide it, and what to do; topics: stream -> topic; frames: left images to
    come; cameras: the calibrated pair, where both are there; static: the log's static transforms.
    """

    path: Path
    source: McapSource
    start: float | None = None
    end: float | None = None
    missing: dict[str, str] = field(default_factory=dict, init=False)
    topics: dict[str, str] = field(default_factory=dict, init=False)
    cameras: tuple[Camera, Camera] | None = field(default=None, init=False)
    static: Frames = field(default_factory=Frames, init=False)
    mount: Mount | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self.file = McapFile(self.path)
        try:
            self._problems: list[LogError] = []
            self._infos: list[tuple[str, str, Any]] = []
            self._decoders = self._find_decoders()
            self._find()
            self._check_range()
        except BaseException:
            self.file.close()
            raise

    @property
    def frames(self) -> int | None:
        """How many left images are to come; None where the log has none."""
        if "left" not in self.topics:
            return None
        low, high = self._range()
        if low is None and high is None:
            return self.file.count(self.topics["left"])
        times = self.file.times(self.topics["left"])
        return int(np.sum((times >= (low or 0)) & (times < (high or 1 << 62))))

    def __iter__(self) -> Iterator[tuple[int, str, Any]]:
        return self.events(tuple(McapSource.streams))

    def events(self, streams: Sequence[str]) -> Iterator[tuple[int, str, Any]]:
        """Iterates as the log does, over some of its streams."""
        low, high = self._range()
        readings = [reading for reading in self._readings() if reading.stream in streams]
        by_channel = {channel: reading for reading in readings for channel in reading.decoders}
        wide_low = None if low is None else max(low - LEAD, 0)
        wide_high = None if high is None else high + LEAD
        log_start = self.file.start if wide_low is None else max(wide_low, self.file.start)
        for problem in self._problems:
            yield log_start, "log", problem
        if self.mount is not None and "mount" in streams:
            yield log_start, "mount", self.mount
        for raw in self.file.messages(set(by_channel), wide_low, wide_high):
            if raw.channel is None:
                yield raw.log_time, "log", LogError(f"{self.path.name}: {raw.reason}")
                continue
            reading = by_channel[raw.channel]
            if isinstance(raw, Lost):
                yield raw.log_time, reading.stream, LogError(f"{reading.topic}: {raw.reason}")
            elif reading.stream not in CAMERAS or self._is_within(raw.data, raw.log_time, low, high):
                item = _decoded(reading, raw.channel, raw.data, raw.log_time)
                if item is not None:
                    yield raw.log_time, reading.stream, item

    def schema(self, topic: str) -> str:
        """The schema of a topic, its full ROS 2 name."""
        return self._schemas[topic]

    def close(self) -> None:
        """Close the file."""
        self.file.close()

    def __enter__(self) -> McapLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # Opening

    def _find_decoders(self) -> dict[int, Callable[[bytes | memoryview], Any]]:
        """Decoders of the channels that may matter; what cannot be decoded is as if it were not there."""
        self._schemas: dict[str, str] = {}
        decoders = {}
        for number, channel in self.file.index.channels.items():
            schema = self.file.schema(channel)
            if schema is None or channel.message_encoding != "cdr":
                continue
            try:
                decoders[number] = decoder_for(schema.name, schema.encoding, schema.data)
            except LogError:
                continue
            self._schemas[channel.topic] = full_name(schema.name)
        return decoders

    def _find(self) -> None:
        topics = [Topic(name, schema, self.file.count(name)) for name, schema in sorted(self._schemas.items())]
        for topic in topics:
            if topic.schema == TRANSFORMS and topic.name.endswith("tf_static"):
                self._read_static(topic.name)
        oriented = [t.name for t in topics if t.schema == IMU and t.messages and self._has_orientation(t.name)]
        found = discover(topics, self.source, oriented, self.source.angles() is not None)
        self.missing.update(found.missing)
        self.topics.update({role: name for role, name in found.chosen.items() if role in McapSource.streams})
        self._find_cameras(found)
        self._find_mount()
        for stream in self.missing:
            self.topics.pop(stream, None)

    def _read_static(self, topic: str) -> None:
        for message in self._messages(topic):
            try:
                self.static.add(message if not isinstance(message, LogError) else _raised(message))
            except (LogError, ValueError) as error:
                self._problems.append(LogError(f"{topic}: {error}"))

    def _find_cameras(self, found: Topics) -> None:
        roles = ("left", "right", "left_info", "right_info")
        if any(role not in found.chosen for role in roles):
            return
        infos = [self._first(found.chosen[role]) for role in roles[2:]]
        for side, info in zip(CAMERAS, infos, strict=True):
            if isinstance(info, LogError):
                self.missing[side] = f"the calibration on {found.chosen[side + '_info']} cannot be read: {info}"
        if "left" in self.missing or "right" in self.missing:
            return
        self._infos = [
            (side, found.chosen[role], info) for side, role, info in zip(CAMERAS, roles[2:], infos, strict=True)
        ]
        try:
            topics = (found.chosen["left"], found.chosen["right"])
            self.cameras = calibrated_pair(infos[0], infos[1], topics, self.static)
        except (LogError, ValueError) as error:
            self.missing.update(left=str(error), right=str(error))

    def _find_mount(self) -> None:
        if self.cameras is None:
            self.missing["mount"] = (
                f"without a calibrated left camera there is no mount: {self.missing.get('left', '')}"
            )
        elif "inclinometer" in self.missing:
            self.missing["mount"] = f"without an inclinometer there is no mount: {self.missing['inclinometer']}"
        else:
            first = self._first(self.topics["inclinometer"])
            header = getattr(first, "header", None)
            frame = header.frame_id.lstrip("/") if header is not None else ""
            given = self.source.camera_from_inclinometer
            stamp = min(self.file.start, self._first_stamp(self.topics["left"]))
            try:
                self.mount = mounted(stamp, self.cameras[0], frame, self.source.base_frame, self.static, given)
            except (LogError, ValueError) as error:
                self.missing["mount"] = str(error)

    def _check_range(self) -> None:
        low, high = self._range()
        length = (self.file.end - self.file.start) / 1e9
        if low is not None and low > self.file.end:
            raise LogError(f"{self.path} is {length:.3f} s long; start {self.start} s is behind its end")
        if low is not None and high is not None and low >= high:
            raise LogError(f"start {self.start} s is not before end {self.end} s; give them in that order")

    def _messages(self, topic: str) -> Iterator[Any]:
        """The decoded messages of a topic; a LogError for one that cannot be read."""
        for raw in self.file.messages(self.file.channels_of([topic]) & self._decoders.keys()):
            if isinstance(raw, Lost):
                if raw.channel is not None:
                    yield LogError(raw.reason)
                continue
            try:
                yield self._decoders[raw.channel](raw.data)
            except Exception as error:  # foreign bytes may fail a codec in any way
                yield LogError(said(error))

    def _first(self, topic: str) -> Any:
        """The first message of a topic that can be read, else the LogError of the last that cannot."""
        message: Any = LogError(f"{topic} has no messages")
        for message in self._messages(topic):
            if not isinstance(message, LogError):
                return message
        return message

    def _first_stamp(self, topic: str) -> int:
        """The stamp of a topic's first message: it may be before the log's first log time, or of another clock."""
        raws = self.file.messages(self.file.channels_of([topic]))
        first = next((raw for raw in raws if not isinstance(raw, Lost)), None)
        return self.file.start if first is None else max(peek_stamp(first.data) or first.log_time, 0)

    def _has_orientation(self, topic: str) -> bool:
        first = self._first(topic)
        return not isinstance(first, LogError) and first.orientation_covariance[0] != -1

    # Reading

    def _range(self) -> tuple[int | None, int | None]:
        """The range in log time, ns."""
        low = None if self.start is None else self.file.start + round(self.start * 1e9)
        high = None if self.end is None else self.file.start + round(self.end * 1e9)
        return low, high

    def _is_within(self, data: memoryview, log_time: int, low: int | None, high: int | None) -> bool:
        """Whether an image belongs to the range. By its stamp, where that is of the log's clock: then both images of a
        frame are in or out, though they were logged one after the other."""
        if low is None and high is None:
            return True
        stamp = peek_stamp(data) or log_time
        when = stamp if abs(stamp - log_time) < LEAD else log_time
        return (low is None or when >= low) and (high is None or when < high)

    def _readings(self) -> list[Reading]:
        """The topics to read. Calibrations are read along, to notice when they change."""
        angles = self.source.angles()
        made: dict[str, Callable[[Any, int], Any]] = {
            "inclinometer": angles if angles is not None else tilt_of,
            "odometry": lambda message, log_time: pose_of(message, log_time, self.source.base_frame),
        }
        if self.cameras is not None:
            made |= {side: partial(_image, camera) for side, camera in zip(CAMERAS, self.cameras, strict=True)}
        streams: list[tuple[str, str, Callable[[Any, int], Any]]]
        streams = [(stream, topic, made[stream]) for stream, topic in self.topics.items() if stream in made]
        streams += [(side, topic, Unchanged(info)) for side, topic, info in self._infos if side in self.topics]
        return [Reading(stream, topic, self._decoders_of(topic), item) for stream, topic, item in streams]

    def _decoders_of(self, topic: str) -> dict[int, Callable[[bytes | memoryview], Any]]:
        return {n: self._decoders[n] for n in self.file.channels_of([topic]) if n in self._decoders}


def _decoded(reading: Reading, channel: int, data: memoryview, log_time: int) -> Any:
    try:
        return reading.item(reading.decoders[channel](data), log_time)
    except Exception as error:  # foreign bytes may fail a codec in any way; the message is lost, not the log
        return LogError(f"{reading.topic} at {log_time} ns: {said(error)}")


def _image(camera: Camera, message: Any, log_time: int) -> CameraImage:
    stamp = stamp_or(message.header, log_time)
    frame = camera.frame_id or message.header.frame_id.lstrip("/")
    return CameraImage(stamp, pixels_of(message), camera.model, frame, camera.rectified)


def peek_stamp(data: memoryview) -> int:
    """The stamp, ns, of a CDR message that begins with a std_msgs/Header, without decoding it; 0 if it is too short."""
    if len(data) < 12:
        return 0
    seconds, nanoseconds = struct.unpack_from("<iI" if data[1] else ">iI", data, 4)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def _raised(error: LogError) -> Any:
    raise error


__all__ = ["IMAGES", "McapLog", "McapSource", "peek_stamp"]
