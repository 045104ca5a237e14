"""Two logs read side by side: the messages of one header stamp, from both, as one frame."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from itertools import islice
from operator import itemgetter
from typing import Any

import numpy as np

from recordings.errors import LogError
from recordings.ros2.from_msg import stamp_of
from stages.data import LEVEL_FRAME

MAX_DELAY = 5_000_000_000  # ns between the header stamps of messages that a log has in another order
_AHEAD = 32  # messages, over two frames of the truth; a wrong later stamp of one of them delays no other

Messages = Iterator[tuple[str, int, Any]]  # topic, log time in ns, message


def frames(*logs: Messages) -> Iterator[tuple[int, dict[str, Any]]]:
    """(stamp, {topic: message}) of all frames, each when it is complete.

    Of /tf, "/tf" is the list of transforms whose parent is frame `level`. Log times do not count: simulators often
    log by another clock. Raises LogError for two different messages of a topic at one stamp.
    """
    waiting: dict[int, dict[str, Any]] = {}
    for latest, stamp, topic, message in heapq.merge(*map(_stamped, logs), key=itemgetter(0)):
        frame = waiting.setdefault(stamp, {})
        if topic != "/tf" and topic in frame and not _are_same(frame[topic], message):
            raise LogError(f"two messages of {topic} at {stamp} ns differ; give the truth and the result of one log")
        frame[topic] = [*frame.get(topic, []), message] if topic == "/tf" else message
        for stamp in [stamp for stamp in waiting if stamp < latest - MAX_DELAY]:
            yield stamp, waiting.pop(stamp)
    for stamp in sorted(waiting):
        yield stamp, waiting.pop(stamp)


def _are_same(one: Any, other: Any) -> bool:
    """Whether two messages, or parts of them, have the same content."""
    if is_dataclass(one):
        return type(one) is type(other) and all(
            _are_same(getattr(one, item.name), getattr(other, item.name)) for item in fields(one)
        )
    if isinstance(one, np.ndarray):
        return isinstance(other, np.ndarray) and one.tobytes() == other.tobytes()
    if isinstance(one, list):
        return len(one) == len(other) and all(map(_are_same, one, other))
    return repr(one) == repr(other)  # NaN is like NaN


def _stamped(messages: Messages) -> Iterator[tuple[int, int, str, Any]]:
    """The earliest header stamp of a message and those ahead, and its own stamp, topic and message."""
    items = (
        (stamp_of(item.header), topic, item)
        for topic, _, message in messages
        for item in (message.transforms if topic == "/tf" else (message,))
        if topic != "/tf" or item.header.frame_id == LEVEL_FRAME
    )
    ahead = deque(islice(items, _AHEAD))
    while ahead:
        yield min(stamp for stamp, _, _ in ahead), *ahead.popleft()
        ahead.extend(islice(items, 1))
