"""The calibration of a log's cameras from files, in place of its CameraInfo messages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from recordings.calibration.formats import read_calibration
from recordings.errors import LogError
from recordings.source.cameras import CAMERAS, CalibrationTopic, some_image
from recordings.source.topics import DecodedTopics
from recordings.source.transforms import TransformTree, rigid
from stages.data import CameraModel

INCLINOMETER = "inclinometer"  # the frame of a tilt whose messages name none


def calibrations_of_files(
    given: str | tuple[str, ...], messages: DecodedTopics, chosen: Mapping[str, str], tree: TransformTree
) -> dict[str, CalibrationTopic]:
    """Side -> its calibration in the files; their transforms become part of the tree.

    given: paths; chosen: role (left, right, inclinometer) -> topic. Raises LogError for files that cannot be used.
    """
    paths = [Path(path) for path in ([given] if isinstance(given, str) else given)]
    calibration = read_calibration(paths)
    if any(side not in chosen for side in CAMERAS):
        return {}
    topics = tuple(chosen[side] for side in CAMERAS)
    if calibration.topics == topics[::-1]:
        calibration = calibration.exchanged()
    shown = " and ".join(map(str, paths))
    if calibration.baseline < 0 and set(calibration.topics) != set(topics):
        remedy = (
            f"name {topics[0]} and {topics[1]} as 'rostopic' of its cameras"
            if any(calibration.topics)
            else "write the left camera first"
        )
        raise LogError(
            f"the first camera of {shown} is the right one (baseline {calibration.baseline:.4g} m); {remedy}"
        )
    frames = [messages.frame_of(topic) for topic in topics]
    if not all(frames) or frames[0] == frames[1]:
        frames = [f"{side}_camera" for side in CAMERAS]
    inclinometer = messages.frame_of(chosen.get("inclinometer", "")) or INCLINOMETER
    found = (frames[1], calibration.right_in_left), (inclinometer, calibration.camera_from_imu)
    joined = tree.joined(rigid(frames[0], child, matrix) for child, matrix in found if matrix is not None)
    tree.edges.update(joined.edges)  # the frames of the files may have other parents in the log
    tree.calibrated.update(joined.edges)
    models = (_sized(model, messages, topic) for model, topic in zip(calibration.models, topics, strict=True))
    sides = zip(CAMERAS, models, frames, strict=True)
    return {side: CalibrationTopic(shown, model, frame) for side, model, frame in sides}


def _sized(model: CameraModel, messages: DecodedTopics, topic: str) -> CameraModel:
    """The calibration, with the size of the images where its file has none."""
    if model.width and model.height:
        return model
    pixels = some_image(messages, topic)
    if not isinstance(pixels, np.ndarray):
        why = "it has no messages" if pixels is None else pixels
        raise LogError(f"the calibration has no size of the images, and no image of {topic} can be read: {why}")
    return replace(model, width=pixels.shape[1], height=pixels.shape[0])
