"""The readers of a log's streams: which topic is read for each, and how its messages become items."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from recordings.errors import LogError
from recordings.inertial.blocks import InertialSample
from recordings.ros2.from_msg import frame_of, pose_of
from recordings.source.cameras import CAMERAS, CalibrationHistory, ImageReading
from recordings.source.mount import pose_of_base
from recordings.source.moving_mount import MovingMount
from recordings.source.resolution import SourceResolution
from recordings.source.settings import LogSettings
from recordings.source.tilt_noise import TiltNoise
from recordings.source.tilt_reading import Sampler
from recordings.source.topics import TopicReader
from recordings.video.decoder import VideoDecoder
from stages.data import Pose, Tilt


@dataclass(frozen=True)
class StreamReaders:
    """Makes the readers of a log whose topics are resolved. They have state, so each pass over the log has its own."""

    resolution: SourceResolution
    source: LogSettings

    def of_calibrations(
        self, calibrations: Mapping[str, CalibrationHistory], streams: Collection[str]
    ) -> list[TopicReader]:
        """Those that add each CameraInfo to the calibrations of its side."""
        return [
            self._reader(side, info.topic, calibrations[side].note)
            for side, info in self.resolution.infos.items()
            if side in self.resolution.topics and side in streams
        ]

    def of_streams(self, calibrations: Mapping[str, CalibrationHistory], streams: Collection[str]) -> list[TopicReader]:
        """Those of images, tilts and poses."""
        topics, messages = self.resolution.topics, self.resolution.messages
        base_frame = self.source.base_frame
        made: dict[str, Callable[[Any, int], Any]] = {
            "odometry": lambda message, log_time: self._rover_pose(pose_of(message, log_time, base_frame)),
        }
        for side, camera in zip(CAMERAS, self.resolution.cameras or (), strict=False):
            if side in topics:
                made[side] = ImageReading(camera, calibrations[side], messages.pixel_reader(topics[side]))
        chosen = [(stream, topic) for stream, topic in topics.items() if stream in made and stream in streams]
        readers = [self._reader(stream, topic, made[stream]) for stream, topic in chosen]
        return [*readers, *self._of_tilts()] if "inclinometer" in streams else readers

    def _of_tilts(self) -> list[TopicReader]:
        """Those of the inclinometer; those of an estimate only stand for lost messages."""
        reading, known = self.resolution.tilt, self.resolution.tilt_frame
        if "inclinometer" not in self.resolution.topics or reading is None:
            return []
        if reading.estimates:
            return [
                replace(each, decoders=dict.fromkeys(each.decoders, bytes), item=lambda message, time: None)
                for each in self.of_samples()
            ]
        noise = TiltNoise()

        def checked(tilt: Callable[[Any, int], Tilt | None], message: Any, log_time: int) -> Tilt | None:
            made = tilt(message, log_time)
            if made is None:
                return None
            _check_frame(made.frame_id, known, "mount is that")
            return noise(made)

        readers = reading.readers(self.source)
        return [self._reader("inclinometer", topic, partial(checked, tilt)) for topic, tilt in readers.items()]

    def of_samples(self) -> list[TopicReader]:
        """Those of the samples from which the tilt is estimated."""
        reading = self.resolution.tilt
        if reading is None:
            return []

        def checked(known: str, of: str, sample: Sampler, message: Any, log_time: int) -> InertialSample:
            _check_frame(frame_of(message), known, of)
            return sample(message, log_time)

        readers = list[TopicReader]()
        for topic, sample in reading.samplers(self.source).items():
            of = "mount is that" if topic == reading.topic else "rates are those"
            item = partial(checked, self.resolution.messages.frame_of(topic), of, sample)
            readers.append(self._reader("inclinometer", topic, item))
        return readers

    def of_transforms(self, moving: MovingMount) -> list[TopicReader]:
        """Those of the transforms that move the camera."""
        return [self._reader("mount", topic, moving.add) for topic in moving.topics]

    def _rover_pose(self, pose: Pose | None) -> Pose | None:
        cameras = self.resolution.cameras
        if pose is None or cameras is None:
            return pose
        return pose_of_base(pose, cameras[0], self.source.base_frame, self.resolution.static)

    def _reader(self, stream: str, topic: str, item: Callable[[Any, int], Any]) -> TopicReader:
        messages = self.resolution.messages
        decoders = {number: messages.decoders[number] for number in messages.channels_of(topic)}
        pixels_of = item.pixels_of if isinstance(item, ImageReading) else None
        made = _by_stamp_alone(item) if messages.ahead_of(topic) else item
        return TopicReader(stream, topic, decoders, made, pixels_of if isinstance(pixels_of, VideoDecoder) else None)


def by_channel(readers: Iterable[TopicReader]) -> dict[int, list[TopicReader]]:
    """Number of a channel -> its readers: an Odometry may be the pose and the tilt."""
    found = defaultdict[int, list[TopicReader]](list)
    for reader in readers:
        for channel in reader.decoders:
            found[channel].append(reader)
    return dict(found)


def _check_frame(frame: str, known: str, of: str) -> None:
    """Raise LogError for a message of another sensor on the topic. of: what is known of that frame."""
    if known and frame != known:
        raise LogError(f"its frame is '{frame}', but the {of} of '{known}'")


def _by_stamp_alone(item: Callable[[Any, int], Any]) -> Callable[[Any, int], Any]:
    """The same for stamps of another clock than the log times: a stamp of 0 is one."""
    return lambda message, log_time: item(message, 0)
