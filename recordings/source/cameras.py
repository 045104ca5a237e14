"""The two cameras of a log: their first calibrations, and whether a few of their images can be read and paired."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from recordings.errors import LogError
from recordings.ros2.from_msg import camera_model, frame_of
from recordings.ros2.image_from_msg import pixels_of, unread_encoding
from recordings.source.topics import DecodedTopics
from stages.data import Array, CameraModel

CAMERAS = ("left", "right")


@dataclass(frozen=True)
class CalibrationTopic:
    """The first CameraInfo of a camera. frame_id: its frame, or that of its images if it has none."""

    topic: str
    model: CameraModel
    frame_id: str


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


def unreadable_images(messages: DecodedTopics, topics: Mapping[str, str], sides: Collection[str]) -> dict[str, str]:
    """Side -> why its images cannot be read, by the encoding of the first one. topics: side -> topic of its images."""
    unread = dict[str, str]()
    for side in sides:
        why = messages.first(topics[side], unread_encoding)
        if why and not isinstance(why, LogError):
            unread[side] = f"{topics[side]}: {why}; record it in one of these"
    return unread


def mismatched_images(
    messages: DecodedTopics, topics: Mapping[str, str], infos: Mapping[str, CalibrationTopic]
) -> dict[str, str]:
    """Side -> why hardly any frame could be made of its images.

    They cannot be read anywhere in the log, or the first and the last do not fit the calibration or the other side.
    """
    first = _mismatches({side: _pixels(messages, topics[side]) for side in CAMERAS}, topics, infos)
    if not first:
        return {}
    last = _mismatches({side: _pixels(messages, topics[side], last=True) for side in CAMERAS}, topics, infos)
    return {side: why for side, why in first.items() if side in last}


def _pixels(messages: DecodedTopics, topic: str, last: bool = False) -> Array | LogError | None:
    """The first (or last) image that can be decoded, or the last error; None without messages."""
    found = None
    for found in (messages.last if last else messages.sample)(topic, pixels_of):
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
                f"set '{side}_info' of the source to the matching CameraInfo, or record it"
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
    kind = "gray" if pixels.ndim == 2 else "colour"
    return f"{pixels.shape[1]}x{pixels.shape[0]} {kind} of {8 * pixels.itemsize} bit"
