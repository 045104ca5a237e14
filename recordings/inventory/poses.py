"""The poses of a log for its inventory: which of them can be read, their stamps and delays."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flow.contracts import counted
from recordings.containers.container import RawMessage
from recordings.ros2.from_msg import pose_of
from recordings.source.log import McapLog
from recordings.source.topics import attempt
from stages.data import Pose

MAX_READ = 20_000  # poses of a log; of more, a sample is read
SAMPLE_PLACES, SAMPLE_SIZE = 8, 10  # parts of a log, and messages of each; a part is read with its images

MaxGapOf = Callable[[Sequence[int]], int]  # from the intervals of samples, ns, to the largest one around a frame
Item = tuple[int, Any]  # log time, ns, and a pose or an exception


def describe_poses(
    log: McapLog,
    left: NDArray[np.int64],
    pairs: NDArray[np.int64],
    whole: bool,
    max_gap_of: MaxGapOf | None,
    add_damage: Callable[[str], None],
) -> dict[str, Any] | None:
    """The poses of an opened log; None if it has none.

    left, pairs: stamps of the left images and of the stereo pairs, ns; whole: whether the log is small enough to read
    all its messages; max_gap_of: from the intervals of the poses to the largest one around a frame, None: do not count
    pairs with a pose; add_damage: receives a sentence for each message that cannot be read.
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
    distinct = np.unique(np.asarray(stamps, np.int64))
    max_gap = None if max_gap_of is None or not whole else max_gap_of(np.diff(distinct).tolist())
    with_pose, in_gap = (None, 0) if max_gap is None else sampled(pairs, distinct, max_gap)
    if in_gap:
        add_damage(gap_sentence(in_gap, pairs, "poses", max_gap))
    covered = (left >= min(stamps)) & (left <= max(stamps)) if stamps else np.zeros(0)
    return {
        "readable": len(stamps),
        "unreadable": errors,
        "images_covered": int(np.sum(covered)),
        "pairs_with_pose": with_pose,
        "delay_s": float(np.median(delays)) / 1e9 if delays else None,
        "offset_s": log.time_offset("odometry") / 1e9,
    }


def gap_sentence(lost: int, pairs: NDArray[np.int64], what: str, max_gap: int | None) -> str:
    """The damage that some stereo pairs are in a gap of the tilts or poses. max_gap: the longest around a frame, ns."""
    of_pairs = f"{lost} of {counted(pairs.size, 'stereo pair')}"
    return f"{of_pairs} in a gap of the {what}, over {(max_gap or 0) / 1e9:g} s long; a run loses the {what[:-1]} there"


def sampled(stamps: NDArray[np.int64], samples: NDArray[np.int64], max_gap: int) -> tuple[int, int]:
    """The number of stamps at a sample, or between two that are close enough to interpolate; and of those in a gap."""
    if not samples.size:
        return 0, 0
    after = np.searchsorted(samples, stamps)
    later, earlier = samples[np.minimum(after, samples.size - 1)], samples[np.maximum(after - 1, 0)]
    inside = (after < samples.size) & ((after > 0) | (later == stamps))
    near = inside & ((later == stamps) | (later - earlier <= max_gap))
    return int(np.sum(near)), int(np.sum(inside & ~near))


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
