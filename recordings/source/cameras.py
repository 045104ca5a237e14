"""The two cameras of a log: their first calibrations, and whether a few of their images can be read and paired."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

import numpy as np

from flow.contracts import Finding, Severity
from recordings.errors import LogError
from recordings.ros2.from_msg import camera_model, frame_of, stamp_or
from recordings.source.calibration import Camera
from recordings.source.topics import DecodedTopics
from recordings.source.transforms import TransformTree
from recordings.video.decoder import PixelReader, VideoDecoder
from stages.data import Array, CameraImage, CameraModel

CAMERAS = ("left", "right")
_MAX_LOOKED_AT = 1000  # images, to find one that can be read; a video may begin that far before its key frame


@dataclass(frozen=True)
class CalibrationTopic:
    """The first CameraInfo of a camera. frame_id: its frame, or that of its images if it has none."""

    topic: str
    model: CameraModel
    frame_id: str


@dataclass
class CalibrationHistory:
    """A camera's calibrations by stamp. Only those equal to the first can be used, because the pair was made for it."""

    first: CameraModel
    stamps: list[int] = field(default_factory=list)
    same: list[bool] = field(default_factory=list)

    def note(self, message: Any, log_time: int) -> None:
        """Add a CameraInfo."""
        stamp, model = stamp_or(message.header, log_time), camera_model(message)
        place = bisect_right(self.stamps, stamp)
        self.stamps.insert(place, stamp)
        self.same.insert(place, _equal(model, self.first))

    def check(self, stamp: int) -> None:
        """Raise LogError if the calibration at `stamp` is not the first one."""
        place = bisect_right(self.stamps, stamp)
        if place and not self.same[place - 1]:
            raise LogError(
                "the calibration differs from the log's first one, so the image cannot be used; record two cameras on "
                "two topics, or split the log where it changes"
            )


@dataclass(frozen=True)
class ImageReading:
    """Decodes the images of one camera, unless another calibration than the first was in force."""

    camera: Camera
    calibrations: CalibrationHistory
    pixels_of: PixelReader

    def __call__(self, message: Any, log_time: int) -> CameraImage:
        """The image of a message."""
        model, stamp = self.camera.model, stamp_or(message.header, log_time)
        self.calibrations.check(stamp)
        camera = self.camera if self.camera.frame_id else replace(self.camera, frame_id=frame_of(message))
        pixels = self.pixels_of(message, (model.width, model.height))
        return CameraImage(stamp, pixels, model, camera.image_frame, camera.rectified)


def _equal(one: CameraModel, other: CameraModel) -> bool:
    numbers = all(np.array_equal(getattr(one, name), getattr(other, name)) for name in ("k", "d", "r", "p"))
    return numbers and (one.width, one.height, one.model) == (other.width, other.height, other.model)


def first_calibrations(
    messages: DecodedTopics, chosen: Mapping[str, str]
) -> tuple[dict[str, CalibrationTopic], dict[str, str]]:
    """Side -> its first CameraInfo, and side -> why it cannot be read; both empty if a topic is missing.

    chosen: role (left, right, left_info, right_info) -> topic.
    """
    infos, unread = dict[str, CalibrationTopic](), dict[str, str]()
    if any(role not in chosen for side in CAMERAS for role in (side, f"{side}_info")):
        return infos, unread
    for side in CAMERAS:
        topic = chosen[f"{side}_info"]
        info = messages.first(topic, lambda message: (camera_model(message), frame_of(message)))
        if isinstance(info, LogError):
            unread[side] = f"the calibration on {topic} cannot be read: {info}"
        else:
            infos[side] = CalibrationTopic(topic, info[0], info[1] or messages.frame_of(chosen[side]))
    return infos, unread


def in_known_frames(
    infos: Mapping[str, CalibrationTopic], images: Mapping[str, str], tree: TransformTree
) -> tuple[dict[str, CalibrationTopic], list[tuple[str, Finding]]]:
    """The calibrations with the frames of their images where the tree has only these; and (side, finding) pairs.

    images: side -> frame of its images. A CameraInfo and its images should have one frame. Where they differ and the
    tree has both, that of the CameraInfo is used. By convention that of a right CameraInfo may be the left camera's.
    """
    known, found = dict(infos), list[tuple[str, Finding]]()
    for side, info in infos.items():
        own, other = info.frame_id, images[side]
        differ = f"the frame_id of {info.topic} is '{own}', that of its images is '{other}'"
        if other in tree.edges and own not in tree.edges:
            known[side] = replace(info, frame_id=other)
            found.append((side, Finding(f"{differ}, which is used, because no static transform has '{own}'")))
        elif side == "left" and other in tree.edges and not tree.coincide(own, other):
            used = f"{differ}; the transforms of '{own}' are used; record one frame in both"
            found.append((side, Finding(used, Severity.WARNING)))
    return known, found


def mismatched_images(
    messages: DecodedTopics, topics: Mapping[str, str], infos: Mapping[str, CalibrationTopic]
) -> dict[str, str]:
    """Side -> why hardly any frame could be made of its images.

    They cannot be read anywhere in the log, or the first and the last do not fit the calibration or the other side.
    """
    first = _mismatches({side: some_image(messages, topics[side]) for side in CAMERAS}, topics, infos)
    if not first:
        return {}
    last = _mismatches({side: some_image(messages, topics[side], last=True) for side in CAMERAS}, topics, infos)
    return {side: why for side, why in first.items() if side in last}


def some_image(messages: DecodedTopics, topic: str, last: bool = False) -> Array | LogError | None:
    """The first (or last) image that can be decoded, or the last error; None without messages."""
    found, pixels_of = None, messages.pixel_reader(topic)
    some = messages.each if isinstance(pixels_of, VideoDecoder) else messages.last if last else messages.sample
    for found in islice(some(topic, pixels_of), _MAX_LOOKED_AT):
        if not isinstance(found, LogError):
            break
    return found


def _mismatches(
    images: Mapping[str, Array | LogError | None], topics: Mapping[str, str], infos: Mapping[str, CalibrationTopic]
) -> dict[str, str]:
    """Side -> why its image cannot be read, or does not fit its calibration or the other side."""
    reasons = dict[str, str]()
    for side, pixels in images.items():
        topic, info = topics[side], infos[side]
        if isinstance(pixels, LogError):
            reasons[side] = f"{topic}: {pixels}"
        elif pixels is not None and pixels.shape[:2] != (info.model.height, info.model.width):
            reasons[side] = (
                f"the images on {topic} are {pixels.shape[1]}x{pixels.shape[0]}, but the calibration on {info.topic} "
                f"is for {info.model.width}x{info.model.height} (after binning and region of interest); "
                f"set '{side}_info' of the source to the matching CameraInfo, or 'calibration' to its file"
            )
    left, right = (images[side] for side in CAMERAS)
    if reasons or not isinstance(left, np.ndarray) or not isinstance(right, np.ndarray):
        return reasons
    if _kind(left) != _kind(right):
        one, other = topics["left"], topics["right"]
        why = f"the images on {one} are {_kind(left)}, those on {other} are {_kind(right)}; record both in one format"
        reasons.update(left=why, right=why)
    return reasons


def _kind(pixels: Array) -> str:
    """The properties in which the two images of a frame must agree."""
    return f"{pixels.shape[1]}x{pixels.shape[0]} of {8 * pixels.itemsize} bit"
