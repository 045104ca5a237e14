"""The two cameras of an MCAP log: their first calibrations, and whether frames can be made of their images, as far as
some of them show."""

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
class Info:
    """The first CameraInfo of a camera: its topic, the calibration, the camera's frame (its images', where it has none
    itself)."""

    topic: str
    model: CameraModel
    frame_id: str


def first_infos(messages: DecodedTopics, chosen: Mapping[str, str]) -> tuple[dict[str, Info], dict[str, str]]:
    """Side -> its first CameraInfo, and side -> why that cannot be read; neither where a topic is lacking.

    chosen: role (left, right, left_info, right_info) -> topic.
    """
    infos, unread = dict[str, Info](), dict[str, str]()
    if any(role not in chosen for side in CAMERAS for role in (side, f"{side}_info")):
        return infos, unread
    for side in CAMERAS:
        topic = chosen[f"{side}_info"]
        info = messages.first(topic, lambda message: (camera_model(message), frame_of(message)))
        if isinstance(info, LogError):
            unread[side] = f"the calibration on {topic} cannot be read: {info}"
        else:
            infos[side] = Info(topic, info[0], info[1] or messages.frame_of(chosen[side]))
    return infos, unread


def unread_images(messages: DecodedTopics, topics: Mapping[str, str], sides: Collection[str]) -> dict[str, str]:
    """Which of the sides have a first image in an encoding that cannot be read, and what to do: the others are in it,
    too. topics: side -> topic of its images."""
    unread = dict[str, str]()
    for side in sides:
        why = messages.first(topics[side], unread_encoding)
        if why and not isinstance(why, LogError):
            unread[side] = f"{topics[side]}: {why}; record it in one of these"
    return unread


def unfit_images(messages: DecodedTopics, topics: Mapping[str, str], infos: Mapping[str, Info]) -> dict[str, str]:
    """Which sides have images that cannot be read wherever one looks, or of which the first and the last do not fit
    their calibration or each other, and why: so hardly any frame could be made."""
    first = _misfits({side: _pixels(messages, topics[side]) for side in CAMERAS}, topics, infos)
    if not first:
        return {}
    last = _misfits({side: _pixels(messages, topics[side], last=True) for side in CAMERAS}, topics, infos)
    return {side: why for side, why in first.items() if side in last}


def _pixels(messages: DecodedTopics, topic: str, last: bool = False) -> Array | LogError | None:
    """The first image that can be decoded, or the last; else why not; None where nothing is known."""
    found = None
    for found in (messages.last if last else messages.some)(topic, pixels_of):
        if not isinstance(found, LogError):
            break
    return found


def _misfits(
    images: Mapping[str, Array | LogError | None], topics: Mapping[str, str], infos: Mapping[str, Info]
) -> dict[str, str]:
    """Side -> why there is no image, or it does not fit its calibration or that of the other side."""
    said = dict[str, str]()
    for side, pixels in images.items():
        topic, info = topics[side], infos[side]
        if isinstance(pixels, LogError):
            said[side] = f"{topic}: {pixels}"
        elif pixels is not None and pixels.shape[:2] != (info.model.height, info.model.width):
            said[side] = (
                f"the images on {topic} are {pixels.shape[1]}x{pixels.shape[0]}, but {info.topic}, its binning and "
                f"region of interest counted, is the calibration of images of {info.model.width}x{info.model.height}; "
                f"set '{side}_info' of the source to that of these, or record it"
            )
    left, right = (images[side] for side in CAMERAS)
    if said or not isinstance(left, np.ndarray) or not isinstance(right, np.ndarray):
        return said
    if _kind(left) != _kind(right):
        one, other = topics["left"], topics["right"]
        why = f"the images on {one} are {_kind(left)}, those on {other} {_kind(right)}; record both alike"
        said.update(left=why, right=why)
    return said


def _kind(pixels: Array) -> str:
    """What the two images of a frame have in common, in words."""
    kind = "gray" if pixels.ndim == 2 else "colour"
    return f"{pixels.shape[1]}x{pixels.shape[0]} {kind} of {8 * pixels.itemsize} bit"
