"""Replays a log as the streams of a pipeline: two cameras, tilt, mount and pose.

Only the resolved topics are decoded. An exception is delivered in place of a broken message. Calibrations are read a
little ahead of the images, so that no image is delivered with a calibration that was not in force.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from heapq import merge
from itertools import chain, islice
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from flow.contracts import Finding, Severity
from recordings.containers.clock import MAX_JITTER_NS
from recordings.containers.container import LostMessage, RawMessage
from recordings.containers.opening import open_recording
from recordings.containers.time_range import EDGE_NS, MAX_LATENESS_NS, FramesInRange, TimeRange
from recordings.discovery.roles import TRANSFORMS
from recordings.errors import LogError
from recordings.inertial.up_estimator import LOOKAHEAD_NS, UpEstimator
from recordings.ros2.tilt_from_msg import MAX_STATED_SIGMA
from recordings.source.cameras import CAMERAS, CalibrationHistory
from recordings.source.moving_mount import MAX_GAP_NS, MovingMount
from recordings.source.resolution import SourceResolution
from recordings.source.settings import LogSettings
from recordings.source.stream_readers import StreamReaders, by_channel
from recordings.source.tilt_reading import Sampled, TiltReading, estimated_tilts, in_order_of_stamps
from recordings.source.topics import TopicReader, attempt, with_lookahead
from recordings.video.formats import VIDEO, VIDEO_NOTE
from stages.data import CameraImage, Mount, Tilt

INTERPOLATION_LEAD_NS = 1_000_000_000  # tilt and pose are read this far beyond a range, for interpolation at its ends
MAX_CALIBRATION_LAG_NS = 100_000_000  # a calibration may be logged this much later than its image
MAX_TRANSFORM_LAG_NS = MAX_GAP_NS + 500_000_000  # so much later than an image is the next transform logged at most
_MAX_KEY_INTERVAL = 1000  # frames before a range in which the key frame of a video is searched
EXCERPT_FRAMES = 4  # so that an excerpt survives a broken frame
UNSTAMPED = "the header stamps are 0, so log times are used"
STREAMS = (*CAMERAS, "inclinometer", "mount", "odometry")


@dataclass
class McapLog(AbstractContextManager["McapLog"]):
    """An opened log.

    missing: stream -> why the log does not provide it, and the remedy; refused: setting of the source that contradicts
    the log -> reason; topics: stream -> topic; resolution: the rest of what the log provides.
    """

    given: Path | str | Sequence[Path | str]
    source: LogSettings
    start: float | None = None
    end: float | None = None
    resolution: SourceResolution = field(init=False)
    missing: Mapping[str, str] = field(init=False)
    refused: Mapping[str, str] = field(init=False)
    topics: Mapping[str, str] = field(init=False)
    _estimator: UpEstimator | None = field(init=False, default=None)  # the last one
    _moving: MovingMount | None = field(init=False, default=None)  # the last one

    def __post_init__(self) -> None:
        self.file = open_recording(self.given)
        try:
            self.path = self.file.path
            self._check_range()
            self.resolution = resolution = SourceResolution(self.file, self.source)
            self._readers = StreamReaders(resolution, self.source)
            self.missing, self.refused, self.topics = resolution.missing, resolution.refused, resolution.topics
            self._check_images()
        except BaseException:
            self.file.close()
            raise

    @property
    def begin(self) -> int:
        """The log time of the first message, ns."""
        return self.file.start

    @property
    def first_stamp(self) -> int:
        """The log time of the first message, on the clock of the left images' stamps, ns."""
        return self.begin + self.resolution.messages.ahead_of(self.topics.get("left", ""))

    @property
    def frames(self) -> int | None:
        """The number of left images in the range; None if the log has none."""
        if "left" not in self.topics:
            return None
        part, times = self._range(), self.file.times(self.channels("left"))
        return int(np.sum((times >= (part.low or 0)) & (times < (part.high or 1 << 62))))

    def narrow(self, start: float, end: float) -> None:
        """Read only this part from now on, s after the first message."""
        self.start, self.end = start, end

    def events(self, streams: Collection[str] = STREAMS, estimate: bool = True) -> Iterator[tuple[int, str, Any]]:
        """(Log time in ns, stream, item) for each message of some streams; a lost item is an exception.

        estimate: whether to estimate tilts; else the samples of their stamps are the items.
        """
        part = self._range()
        return self._between(FramesInRange(part, self._lefts_around(part)), streams, estimate=estimate)

    def excerpts(self, count: int, streams: Collection[str]) -> Iterator[Iterator[tuple[int, str, Any]]]:
        """The events of a few frames at `count` places of the whole log, independent of the range that is read."""
        times = self.file.times(self.channels("left")).tolist() if "left" in self.topics else []
        ahead = MAX_JITTER_NS if set(streams) <= {*CAMERAS} else INTERPOLATION_LEAD_NS
        for first in sorted({int((part + 0.5) * len(times) / count) for part in range(count)}) if times else ():
            last = min(first + EXCERPT_FRAMES, len(times)) - 1
            # Stamps precede log times, so begin after the previous image.
            low = times[first - 1] + 1 if first else None
            part = TimeRange(low, times[last] + MAX_LATENESS_NS)
            yield self._between(FramesInRange(part, ()), streams, ahead, whole=False)

    def _lefts_around(self, part: TimeRange) -> Iterator[tuple[int, int]]:
        """Stamp and log time, ns, of the left images around the edges of a part."""
        for edge in part.edges if "left" in self.topics else ():
            for raw in self.file.messages(self.channels("left"), edge - MAX_JITTER_NS, edge + EDGE_NS):
                if isinstance(raw, RawMessage):
                    yield self.stamp_of(raw, "left"), raw.log_time

    def _between(
        self, frames: FramesInRange, streams: Collection[str], ahead: int = MAX_LATENESS_NS, whole: bool = True,
        estimate: bool = True,
    ) -> Iterator[tuple[int, str, Any]]:  # fmt: skip
        """The events of some frames. ahead: as for `_read`; whole: as for `_estimated`; estimate: as for `events`."""
        events, tilt = self._read(frames, streams, ahead), self.resolution.tilt
        if "inclinometer" in streams and "inclinometer" in self.topics and tilt is not None and tilt.estimates:
            near = frames.part.widened(INTERPOLATION_LEAD_NS)
            read = self._estimated(tilt, near, whole) if estimate else self._rated(tilt, near)
            events = merge(events, read, key=itemgetter(0))
        for log_time, stream, item in events:
            offset = 0 if isinstance(item, Exception) else self.time_offset(stream)
            yield log_time, stream, replace(item, stamp=item.stamp + offset) if offset else item

    def _rated(self, tilt: TiltReading, part: TimeRange) -> Iterator[tuple[int, str, Any]]:
        """The samples with a rate, to whose stamps tilts are estimated."""
        for log_time, item in in_order_of_stamps(tilt, self._samples(by_channel(self._readers.of_samples()), part)):
            if isinstance(item, LogError) or item.rate is not None:
                yield log_time, "inclinometer", item

    def _estimated(self, tilt: TiltReading, part: TimeRange, whole: bool) -> Iterator[tuple[int, str, Any]]:
        """The estimates of up in a part of the log, also from samples after and before.

        whole: from all before, which show the biases; the estimates are then those of a run of the whole log. Where
        stamps have jumped since its beginning, only the last ones before are read.
        """
        readers = by_channel(self._readers.of_samples())
        source, offset = self.source, self.time_offset("inclinometer")
        wide = part.widened(LOOKAHEAD_NS + min(abs(offset), MAX_LATENESS_NS))
        if whole and not self._have_jumped(self.channels("inclinometer"), wide.low):
            wide = replace(wide, low=None)
        self._estimator = UpEstimator(self.resolution.tilt_frame, source.accelerometer_bias, source.gravity)
        for log_time, item in estimated_tilts(tilt, self._samples(readers, wide), self._estimator):
            if part.has(item.stamp + offset if isinstance(item, Tilt) else 0, log_time):
                yield log_time, "inclinometer", item

    def _have_jumped(self, channels: set[int], since: int | None) -> bool:
        """Whether the stamps of messages from a log time on are of another clock than those at the log's beginning."""
        ahead = list[int]()
        for low in (None, since):
            raws = (raw for raw in self.file.messages(channels, low) if isinstance(raw, RawMessage))
            ahead += [self.stamp_of(raw, "inclinometer") - raw.log_time for raw in islice(raws, 1)]
        return len(ahead) == 2 and abs(ahead[1] - ahead[0]) > MAX_LATENESS_NS

    def _samples(self, readers: dict[int, list[TopicReader]], part: TimeRange) -> Iterator[Sampled]:
        """What these readers read, without lost messages, which `_read` reports."""
        for raw in self.file.messages(set(readers), part.low, part.high):
            if isinstance(raw, RawMessage):
                yield from ((raw.log_time, reader(raw)) for reader in readers[raw.channel])

    def _read(self, frames: FramesInRange, streams: Collection[str], ahead: int) -> Iterator[tuple[int, str, Any]]:
        """The events without estimates. ahead: how much earlier, ns, than the part an image of it may be logged."""
        wide, near = frames.part.widened(MAX_LATENESS_NS, ahead), frames.part.widened(INTERPOLATION_LEAD_NS)
        log_start = max(wide.low or 0, self.file.start)
        for stream, problem in self.resolution.problems:
            if stream in (*streams, "log"):
                yield log_start, stream, problem
        moving = self.resolution.moving.again() if self.resolution.moving and "mount" in streams else None
        self._moving = moving
        if self.resolution.mount is not None and "mount" in streams and moving is None:
            yield log_start, "mount", self.resolution.mount
        calibrations = {side: CalibrationHistory(info.model) for side, info in self.resolution.infos.items()}
        early = self._readers.of_calibrations(calibrations, streams)
        later = self._readers.of_streams(calibrations, streams)
        if log_start > self.file.start:
            for infos in early:  # the calibration in force is the last readable one before
                next((raw for raw in self._back_from(log_start, infos) if infos(raw) is None), None)
        if moving is not None:
            early += self._readers.of_transforms(moving)
        videos = [reader for reader in later if reader.video is not None]
        if wide.low is not None:
            for video in videos:
                self._begin_video(wide.low, video)
        infos_of, readers_of = by_channel(early), by_channel(later)
        lag = MAX_CALIBRATION_LAG_NS if moving is None else MAX_TRANSFORM_LAG_NS
        raws = self.file.messages(infos_of.keys() | readers_of.keys(), wide.low, wide.high)
        for raw, found in with_lookahead(raws, infos_of, lag):
            channel = -1 if raw.channel is None else raw.channel
            if isinstance(raw, LostMessage):
                for video in videos:
                    video.note_lost(raw.channel)
                if near.has(0, raw.log_time):
                    yield self._loss(raw, [*readers_of.get(channel, []), *infos_of.get(channel, [])])
                continue
            for reader in readers_of.get(channel, []):
                # Later images of a video need those before.
                if reader.video is not None or self._is_inside(raw, reader.stream, near, frames):
                    found.append((reader.stream, reader(raw)))
            for stream, item in found:
                if item is None or not self._is_inside(raw, stream, near, frames):
                    continue
                if moving is not None and stream == "left" and isinstance(item, CameraImage):
                    mount = attempt(moving.at, item.stamp)
                    if isinstance(mount, Mount):
                        yield raw.log_time, "mount", mount
                    else:
                        item = mount
                yield raw.log_time, stream, item

    def _loss(self, lost: LostMessage, readers: Sequence[TopicReader]) -> tuple[int, str, LogError]:
        """The event of a lost message."""
        if not readers:
            return lost.log_time, "log", LogError(f"{self.path.name}: {lost.reason}")
        return lost.log_time, readers[-1].stream, LogError(f"{readers[-1].topic}: {lost.reason}")

    def _is_inside(self, raw: RawMessage, stream: str, near: TimeRange, frames: FramesInRange) -> bool:
        """Whether a message belongs to a part, or, of other streams than the images, to its surroundings."""
        if not frames.part.edges:
            return True
        stamp = self.stamp_of(raw, stream)
        return frames.has(stream, stamp, raw.log_time) if stream in CAMERAS else near.has(stamp, raw.log_time)

    def _back_from(self, log_time: int, reader: TopicReader, most: int | None = None) -> Iterator[RawMessage]:
        """The messages of a reader before `log_time`, the last first, of at most `most` log times."""
        channels = set(reader.decoders)
        times = self.file.times(channels)
        for time in times[times < log_time][::-1][:most].tolist():
            yield from (raw for raw in self.file.messages(channels, time, time + 1) if isinstance(raw, RawMessage))

    def _begin_video(self, log_time: int, reader: TopicReader) -> None:
        """Decode a video from the last key frame before `log_time`."""
        key = next(filter(reader.begins_video, self._back_from(log_time, reader, _MAX_KEY_INTERVAL)), None)
        for raw in self.file.messages(set(reader.decoders), key.log_time, log_time) if key is not None else ():
            if isinstance(raw, RawMessage):
                reader(raw)
            else:
                reader.note_lost(raw.channel)

    def notes(self) -> dict[str, str]:
        """Stream -> note: missing stamps, the source of the baseline, an unknown base frame."""
        messages = self.resolution.messages
        notes = [(stream, UNSTAMPED) for stream, topic in self.topics.items() if messages.is_unstamped(topic)]
        if any(self._schema(side) == VIDEO for side in CAMERAS):
            notes.append(("left", VIDEO_NOTE))
        notes += [*self.resolution.notes(self._estimator), ("odometry", self._clock_of_poses())]
        notes.append(("inclinometer", self._unknown_tilt()))
        notes += [("left", note) for note in self.file.notes if "left" in self.topics]
        noted = dict.fromkeys(stream for stream, note in notes if note)
        return {stream: "; ".join(note for of, note in notes if of == stream and note) for stream in noted}

    def _unknown_tilt(self) -> str:
        """A note if the first message with a tilt states that it is unknown; else empty."""
        if (tilt := self.resolution.tilt) is None or tilt.estimates:
            return ""
        read = tilt.readers(self.source)[tilt.topic]
        made = self.resolution.messages.first(tilt.topic, lambda message: read(message, 0))
        if not isinstance(made, Tilt) or (made.sigma or 0.0) < MAX_STATED_SIGMA:
            return ""
        return (
            f"the covariance on {tilt.topic} states that roll and pitch are unknown, so common_variance of the map is "
            "large; if the driver knows them, correct its covariance"
        )

    def _clock_of_poses(self) -> str:
        """A note if the poses' stamps are of another clock than the images', with the setting; else empty."""
        if not {"left", "odometry"} <= self.topics.keys() or self._schema("odometry") == TRANSFORMS:
            return ""  # the stamps of transforms are not in a header
        left, poses = (self.resolution.messages.ahead_of(self.topics[stream]) for stream in ("left", "odometry"))
        differ = abs(poses + self.time_offset("odometry") - left)
        if differ <= self.file.end - self.file.start:
            return ""
        setting = f"--set source.time_offset.odometry={(left - poses) / 1e9:.3f}s"
        return (
            f"the stamps of poses and images are of clocks that differ by {differ / 1e9:.1f} s; record both with one; "
            f"{setting} corrects the poses, if both are logged equally soon"
        )

    def faults(self) -> dict[str, Finding]:
        """Stream -> what is wrong with it, by what the log states or by what a run has shown."""
        found = dict[str, Finding]()
        notes = self.notes()
        for severity in (Severity.WARNING, Severity.FAULT):
            for side, each in self.resolution.findings:
                if each.severity is severity and side in self.topics:
                    found[side] = replace(each, sentence=notes[side])
        if self._estimator and self.resolution.tilt and (fault := self.resolution.tilt.fault(self._estimator)):
            found["inclinometer"] = fault
        if self._moving and (gaps := self._moving.gaps(self.first_stamp)):
            found["mount"] = Finding(f"{notes['mount']}; {gaps}", Severity.WARNING)
        return found

    def stamp_of(self, raw: RawMessage, stream: str) -> int:
        """The stamp of a message as an item of a stream, ns."""
        return (self.resolution.messages.stamp_of(raw) or raw.log_time) + self.time_offset(stream)

    def time_offset(self, stream: str) -> int:
        """The time that is added to the stamps of a stream, ns."""
        return self.source.offset_of(stream)

    def channels(self, stream: str) -> set[int]:
        """The channels of a stream."""
        return self.resolution.messages.channels_of(self.topics[stream])

    def close(self) -> None:
        """Close the file."""
        self.file.close()

    def __exit__(self, *raised: object) -> None:
        self.close()

    def _check_range(self) -> None:
        low, high = self._range().low, self._range().high
        length = (self.file.end - self.file.start) / 1e9
        if low is not None and low > self.file.end:
            raise LogError(f"{self.path} is {length:.3f} s long; start {self.start} s is after its end")
        if low is not None and high is not None and low >= high:
            raise LogError(f"start {self.start} s is not before end {self.end} s; give a smaller start or a larger end")

    def _check_images(self) -> None:
        """Refuse a range without a left image."""
        part = self._range()
        if "left" not in self.topics or not part.edges:
            return
        ranges = part, part.widened(MAX_LATENESS_NS)  # in the first one is an image, unless stamps and log times differ
        raws = chain.from_iterable(self.file.messages(self.channels("left"), each.low, each.high) for each in ranges)
        if not any(isinstance(raw, LostMessage) or part.has(self.stamp_of(raw, "left"), raw.log_time) for raw in raws):
            length = (self.file.end - self.file.start) / 1e9
            until = "its end" if self.end is None else f"{self.end:g} s"
            raise LogError(
                f"{self.path} is {length:.3f} s long and has no image on {self.topics['left']} from "
                f"{self.start or 0:g} s to {until}; choose a wider range"
            )

    def _range(self) -> TimeRange:
        """The part of the log to read."""
        return TimeRange.after(self.file.start, self.start, self.end)

    def _schema(self, stream: str) -> str:
        """The full name of the type of a stream's messages, or an empty string."""
        return self.resolution.messages.schemas.get(self.topics.get(stream, ""), "")
