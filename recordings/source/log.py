"""Replays an MCAP log as the streams that a pipeline starts from: two cameras, tilt, mount and pose.

Only what the opening chose is decoded. What is broken is delivered as an exception in its place. Calibrations are read
along, a little ahead of the images, so that none is delivered with a calibration that was not in force.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recordings.errors import LogError, said
from recordings.mcap.file import McapFile
from recordings.mcap.index import Lost, Raw
from recordings.ros2.from_msg import camera_model, frame_of, pose_of, stamp_or
from recordings.ros2.image_from_msg import pixels_of
from recordings.ros2.tilt_from_msg import tilt_of
from recordings.source.calibration import Camera
from recordings.source.cameras import CAMERAS
from recordings.source.discovery import BARE_TILT, IMAGES, POSES, TILTS
from recordings.source.mount import rovers
from recordings.source.resolution import SourceResolution
from recordings.source.settings import LogSettings
from recordings.source.topics import Decoder, peek_stamp
from stages.data import CameraImage, CameraModel, Pose, Tilt

LEAD = 1_000_000_000  # ns; tilt and pose are read this much beyond the ends of a range, to interpolate at its frames
AHEAD = 100_000_000  # ns; so much later a calibration may be logged than the image it is for
EXCERPT = 4  # frames in an excerpt, so that one that is broken is not missed
STAMPED = {*IMAGES, *TILTS, *POSES, BARE_TILT} - {"geometry_msgs/msg/Quaternion"}  # begin with a header
UNSTAMPED = "header stamps are 0: log times are used"
STREAMS = (*CAMERAS, "inclinometer", "mount", "odometry")


@dataclass
class Calibrations:
    """A camera's calibrations in the order of their stamps, of which only those like the first are of use.

    The mount and the partner's calibration were made for the first.
    """

    first: CameraModel
    stamps: list[int] = field(default_factory=list)
    same: list[bool] = field(default_factory=list)

    def note(self, message: Any, log_time: int) -> None:
        """Take note of a CameraInfo."""
        stamp, model = stamp_or(message.header, log_time), camera_model(message)
        place = bisect_right(self.stamps, stamp)
        self.stamps.insert(place, stamp)
        self.same.insert(place, _equal(model, self.first))

    def check(self, stamp: int) -> None:
        """Raise LogError if another calibration than the first is in force at `stamp`."""
        place = bisect_right(self.stamps, stamp) - 1
        if place >= 0 and not self.same[place]:
            raise LogError(
                "the calibration has changed since the log began, so the image cannot be used; cut the log in two "
                f"where it changes ({self._since(place)})"
            )

    def _since(self, place: int) -> str:
        """Since when a calibration like that at `place` is in force; not known where it is the first that was noted."""
        while place > 0 and not self.same[place - 1]:
            place -= 1
        return f"{'' if place else 'at or before '}{self.stamps[place]} ns"


def _equal(one: CameraModel, other: CameraModel) -> bool:
    numbers = all(np.array_equal(getattr(one, name), getattr(other, name)) for name in ("k", "d", "r", "p"))
    return numbers and (one.width, one.height, one.model) == (other.width, other.height, other.model)


@dataclass
class TopicReader:
    """One topic as it is read: the stream it makes, its decoders by channel, and what makes an item of a message (of a
    message at a log time; None makes none)."""

    stream: str
    topic: str
    decoders: dict[int, Decoder]
    item: Callable[[Any, int], Any]

    def __call__(self, raw: Raw) -> Any:
        """The item of a message, or the LogError of one that is lost."""
        try:
            return self.item(self.decoders[raw.channel](raw.data), raw.log_time)
        except Exception as error:  # foreign bytes may fail a codec in any way; the message is lost, not the log
            return LogError(f"{self.topic} at {raw.log_time} ns: {said(error)}")


def part_of(first: int, start: float | None, end: float | None) -> tuple[int | None, int | None]:
    """The part of a log from `start` to before `end`, s after its first message, which is of `first`, in log time, ns;
    None where it does not end."""
    low, high = (None if after is None else first + round(after * 1e9) for after in (start, end))
    return low, high


def is_within(stamp: int, log_time: int, low: int | None, high: int | None) -> bool:
    """Whether a message belongs to a part of a log. By its stamp, where it has one of the log's clock: then both images
    of a frame are in or out, though they were logged one after the other."""
    when = stamp if stamp and abs(stamp - log_time) < LEAD else log_time
    return (low is None or when >= low) and (high is None or when < high)


@dataclass
class McapLog:
    """An opened log.

    opening: what it offers, and of that, as the runtime asks for it: missing: stream -> why the log does not provide
    it, and what to do; refused: setting of the source that the log does not bear out -> why; topics: stream -> topic.
    """

    path: Path
    source: LogSettings
    start: float | None = None
    end: float | None = None
    opening: SourceResolution = field(init=False)
    missing: Mapping[str, str] = field(init=False)
    refused: Mapping[str, str] = field(init=False)
    topics: Mapping[str, str] = field(init=False)
    _info_times: dict[str, NDArray[np.int64]] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        self.file = McapFile(self.path)
        try:
            self._check_range()
            self.opening = opening = SourceResolution(self.file, self.source)
            self.missing, self.refused, self.topics = opening.missing, opening.refused, opening.topics
            self._check_images()
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
            return self.file.count(self.channels("left"))
        times = self.file.times(self.channels("left"))
        return int(np.sum((times >= (low or 0)) & (times < (high or 1 << 62))))

    def events(self, streams: Collection[str] = STREAMS) -> Iterator[tuple[int, str, Any]]:
        """(Log time in ns, stream, item) for each message of some streams; an exception as item stands for a loss."""
        return self._between(*self._range(), streams)

    def excerpts(self, count: int, streams: Collection[str]) -> Iterator[Iterator[tuple[int, str, Any]]]:
        """As `events`, `count` times those of a few frames, spread over all of the log, whatever part of it is read."""
        times = self.file.times(self.channels("left")).tolist() if "left" in self.topics else []
        for first in sorted({int((part + 0.5) * len(times) / count) for part in range(count)}) if times else ():
            last = min(first + EXCERPT, len(times)) - 1
            # Stamps are before log times: from behind the image before.
            low = times[first - 1] + 1 if first else self.file.start
            yield self._between(low, times[last] + LEAD, streams)

    def _between(self, low: int | None, high: int | None, streams: Collection[str]) -> Iterator[tuple[int, str, Any]]:
        wide_low, wide_high = _widened(low, high)
        log_start = self.file.start if wide_low is None else max(wide_low, self.file.start)
        for stream, problem in self.opening.problems:
            if stream in (*streams, "log"):
                yield log_start, stream, problem
        if self.opening.mount is not None and "mount" in streams:
            yield log_start, "mount", self.opening.mount
        calibrations = {side: Calibrations(info.model) for side, info in self.opening.infos.items()}
        readings = self._info_readings(calibrations, streams)
        for reading in readings if log_start > self.file.start else ():
            self._note_last_before(log_start, reading)
        infos = self._by_channel(readings)
        items = self._by_channel(self._item_readings(calibrations, streams))
        raws = self.file.messages(infos.keys() | items.keys(), wide_low, wide_high)
        for raw, noted in _ahead(raws, infos):
            if raw.channel is None:
                yield raw.log_time, "log", LogError(f"{self.path.name}: {raw.reason}")
                continue
            reading = (infos if raw.channel in infos else items)[raw.channel]
            if isinstance(raw, Lost):
                yield raw.log_time, reading.stream, LogError(f"{reading.topic}: {raw.reason}")
            elif reading.stream not in CAMERAS or is_within(peek_stamp(raw.data), raw.log_time, low, high):
                item = noted if raw.channel in infos else reading(raw)
                if item is not None:
                    yield raw.log_time, reading.stream, item

    def _note_last_before(self, log_time: int, infos: TopicReader) -> None:
        """Take note of the calibration that was in force at `log_time`: the last one before it that can be read."""
        channels = set(infos.decoders)
        if infos.topic not in self._info_times:
            self._info_times[infos.topic] = self.file.times(channels)
        times = self._info_times[infos.topic]
        for time in reversed(times[times < log_time].tolist()):
            raws = self.file.messages(channels, time, time + 1)
            if any(raw.channel in channels and isinstance(raw, Raw) and infos(raw) is None for raw in raws):
                return

    def notes(self) -> dict[str, str]:
        """Stream -> what there is to say of it: that its messages, going by the first, have no stamps of their own; of
        the right camera, where the baseline is from if not from its CameraInfo alone; of the mount, that the rover's
        frame is not known."""
        notes = {stream: UNSTAMPED for stream, topic in self.topics.items() if self._is_unstamped(stream, topic)}
        if "right" in self.topics and (said := self.opening.baseline_note):
            notes["right"] = "; ".join((*filter(None, [notes.get("right")]), said))
        if self.opening.mount is not None and self.opening.mount.base_from_camera is None:
            notes["mount"] = (
                f"no static transform joins '{self.source.base_frame}' and the camera: heights count from as far below "
                "the camera as the pipeline says (points.camera_height, 1 m unless set), headings from its axis"
            )
        return notes

    def _is_unstamped(self, stream: str, topic: str) -> bool:
        raws = (raw for raw in self.file.messages(self.channels(stream)) if not isinstance(raw, Lost))
        first = next(raws, None) if self.opening.messages.schemas[topic] in STAMPED else None
        return first is not None and len(first.data) >= 12 and not peek_stamp(first.data)

    def channels(self, stream: str) -> set[int]:
        """The channels that a stream is read from."""
        return self.opening.messages.channels_of(self.topics[stream])

    def close(self) -> None:
        """Close the file."""
        self.file.close()

    def __enter__(self) -> McapLog:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def _check_range(self) -> None:
        low, high = self._range()
        length = (self.file.end - self.file.start) / 1e9
        if low is not None and low > self.file.end:
            raise LogError(f"{self.path} is {length:.3f} s long; start {self.start} s is behind its end")
        if low is not None and high is not None and low >= high:
            raise LogError(f"start {self.start} s is not before end {self.end} s; give them in that order")

    def _check_images(self) -> None:
        """Refuse a range without a left image, of which a run would make nothing."""
        low, high = self._range()
        if "left" not in self.topics or (low is None and high is None):
            return
        raws = self.file.messages(self.channels("left"), *_widened(low, high))
        if not any(isinstance(raw, Lost) or is_within(peek_stamp(raw.data), raw.log_time, low, high) for raw in raws):
            length = (self.file.end - self.file.start) / 1e9
            until = "its end" if self.end is None else f"{self.end:g} s"
            raise LogError(
                f"{self.path} is {length:.3f} s long and has no image on {self.topics['left']} from "
                f"{self.start or 0:g} s to {until}; choose a wider range"
            )

    def _range(self) -> tuple[int | None, int | None]:
        """The range in log time, ns."""
        return part_of(self.file.start, self.start, self.end)

    def _info_readings(self, calibrations: dict[str, Calibrations], streams: Collection[str]) -> list[TopicReader]:
        return [
            self._reading(side, info.topic, calibrations[side].note)
            for side, info in self.opening.infos.items()
            if side in self.topics and side in streams
        ]

    def _item_readings(self, calibrations: dict[str, Calibrations], streams: Collection[str]) -> list[TopicReader]:
        tilt, base_frame = self.source.angles() or tilt_of, self.source.base_frame
        made: dict[str, Callable[[Any, int], Any]] = {
            "inclinometer": lambda message, log_time: self._of_the_mount(tilt(message, log_time)),
            "odometry": lambda message, log_time: self._of_the_rover(pose_of(message, log_time, base_frame)),
        }
        for side, camera in zip(CAMERAS, self.opening.cameras or (), strict=False):
            made[side] = _Images(camera, calibrations[side])
        chosen = [(stream, topic) for stream, topic in self.topics.items() if stream in made and stream in streams]
        return [self._reading(stream, topic, made[stream]) for stream, topic in chosen]

    def _of_the_mount(self, tilt: Tilt) -> Tilt:
        """The tilt, if its sensor is the one that the mount speaks of."""
        known = self.opening.tilt_frame
        if known and tilt.frame_id != known:
            raise LogError(f"its frame is '{tilt.frame_id}', but the mount was found for '{known}'")
        return tilt

    def _of_the_rover(self, pose: Pose | None) -> Pose | None:
        cameras = self.opening.cameras
        if pose is None or cameras is None:
            return pose
        return rovers(pose, cameras[0], self.source.base_frame, self.opening.static)

    def _reading(self, stream: str, topic: str, item: Callable[[Any, int], Any]) -> TopicReader:
        messages = self.opening.messages
        decoders = {number: messages.decoders[number] for number in messages.channels_of(topic)}
        return TopicReader(stream, topic, decoders, item)

    @staticmethod
    def _by_channel(readings: Iterable[TopicReader]) -> dict[int, TopicReader]:
        return {channel: reading for reading in readings for channel in reading.decoders}


@dataclass(frozen=True)
class _Images:
    """Makes the images of one camera, each only if the calibration that was in force is the one known."""

    camera: Camera
    calibrations: Calibrations

    def __call__(self, message: Any, log_time: int) -> CameraImage:
        model, stamp = self.camera.model, stamp_or(message.header, log_time)
        self.calibrations.check(stamp)
        camera = self.camera if self.camera.frame_id else replace(self.camera, frame_id=frame_of(message))
        pixels = pixels_of(message, (model.width, model.height))
        return CameraImage(stamp, pixels, model, camera.image_frame, camera.rectified)


def _ahead(raws: Iterable[Raw | Lost], early: dict[int, TopicReader]) -> Iterator[tuple[Raw | Lost, Any]]:
    """The messages in their order, with what became of those that are read `early`: `AHEAD` before they come."""
    waiting: deque[tuple[Raw | Lost, Any]] = deque()
    for raw in raws:
        waiting.append((raw, early[raw.channel](raw) if isinstance(raw, Raw) and raw.channel in early else None))
        while waiting[0][0].log_time < raw.log_time - AHEAD:
            yield waiting.popleft()
    yield from waiting


def _widened(low: int | None, high: int | None) -> tuple[int | None, int | None]:
    """The range of log times in which messages with stamps from `low` to `high`, ns, may be."""
    return None if low is None else max(low - LEAD, 0), None if high is None else high + LEAD
