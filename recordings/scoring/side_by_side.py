"""Two logs read side by side in time: the messages of one header stamp, from both, as one frame."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from itertools import chain
from typing import Any

from recordings.ros2.from_msg import stamp_of
from stages.data import LEVEL_FRAME

MAX_DELAY = 5_000_000_000  # ns of log time between the messages of one frame
OFFSET_STAMPS = 9  # stamps that the offset between a log's clock and its header stamps is found from

Messages = Iterator[tuple[str, int, Any]]  # topic, log time in ns, message


def frames(*logs: Messages) -> Iterator[tuple[int, dict[str, Any]]]:
    """(stamp, {topic: message}) of all frames, each when it is complete.

    Of /tf, "/tf" is the list of transforms whose parent is frame `level`.
    """
    waiting: dict[int, dict[str, Any]] = {}
    for topic, time, message in heapq.merge(*map(_by_header_clock, logs), key=lambda item: item[1]):
        if topic == "/tf":
            for item in message.transforms:
                if item.header.frame_id == LEVEL_FRAME:
                    waiting.setdefault(stamp_of(item.header), {}).setdefault("/tf", []).append(item)
            continue
        waiting.setdefault(stamp_of(message.header), {})[topic] = message
        for stamp in [stamp for stamp in waiting if stamp < time - MAX_DELAY]:
            yield stamp, waiting.pop(stamp)
    for stamp in sorted(waiting):
        yield stamp, waiting.pop(stamp)


def _by_header_clock(messages: Messages) -> Messages:
    """The messages, with log times moved to the clock of their header stamps.

    A simulator's data are often logged by another clock. The offset is the median of the first stamps.
    """
    read, offsets = list[tuple[str, int, Any]](), list[int]()
    for message in messages:
        read.append(message)
        if hasattr(message[2], "header"):
            offsets.append(message[1] - stamp_of(message[2].header))
        if len(offsets) == OFFSET_STAMPS:
            break
    offset = sorted(offsets)[len(offsets) // 2] if offsets else 0
    yield from ((topic, time - offset, found) for topic, time, found in chain(read, messages))
