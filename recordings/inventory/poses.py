"""The poses of a log for its inventory: which of them can be read, their stamps and delays."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recordings.containers.container import RawMessage
from recordings.ros2.from_msg import pose_of
from recordings.source.log import McapLog
from recordings.source.topics import attempt
from stages.data import Pose

MAX_READ = 20_000  # poses of a log; of more, a sample is read
SAMPLE_PLACES, SAMPLE_SIZE = 8, 10  # parts of a log, and messages of each; a part is read with its images

Item = tuple[int, Any]  # log time, ns, and a pose or an exception


def describe_poses(
    log: McapLog, left: NDArray[np.int64], whole: bool, add_damage: Callable[[str], None]
) -> dict[str, Any] | None:
    """The poses of an opened log; None if it has none.

    left: stamps of the left images, ns; whole: whether the log is small enough to read all its messages; add_damage:
    receives a sentence for each message that cannot be read.
    """
    if "odometry" not in log.topics:
        return None
    whole = whole and log.file.count(log.channels("odometry")) <= MAX_READ
    stamps, delays, errors = [], [], 0
    for log_time, item in _all(log) if whole else _sample(log):
        if isinstance(item, Pose):
            stamps.append(item.stamp)
            delays.append(log_time - item.stamp)
        elif item is not None:
            errors += 1
            add_damage(str(item))
    covered = (left >= min(stamps)) & (left <= max(stamps)) if stamps else np.zeros(0)
    return {
        "readable": len(stamps),
        "unreadable": errors,
        "images_covered": int(np.sum(covered)),
        "delay_s": float(np.median(delays)) / 1e9 if delays else None,
        "offset_s": log.time_offset("odometry") / 1e9,
    }


def _all(log: McapLog) -> Iterator[Item]:
    return ((log_time, item) for log_time, stream, item in log.events(("odometry",)) if stream == "odometry")


def _sample(log: McapLog) -> Iterator[Item]:
    """Some messages, spread over the log."""
    topic, channels, messages = log.topics["odometry"], log.channels("odometry"), log.resolution.messages
    offset, seen = log.time_offset("odometry"), set[int]()
    for place in range(SAMPLE_PLACES):
        start = log.file.start + (log.file.end - log.file.start) * place // SAMPLE_PLACES
        for raw in islice(log.file.messages(channels, start), SAMPLE_SIZE):
            if not isinstance(raw, RawMessage) or raw.log_time in seen:
                continue
            seen.add(raw.log_time)
            item = attempt(_pose, messages.decoders[raw.channel], raw, log.source.base_frame, offset)
            yield raw.log_time, f"{topic} at {raw.log_time} ns: {item}" if isinstance(item, Exception) else item


def _pose(decode: Callable[[Any], Any], raw: RawMessage, base_frame: str, offset: int) -> Pose | None:
    pose = pose_of(decode(raw.data), raw.log_time, base_frame)
    return replace(pose, stamp=pose.stamp + offset) if pose is not None else None
