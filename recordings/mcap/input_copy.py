"""Copies the messages of an input log into a result log, byte for byte, so that one file shows both.

Small messages are collected, so that their chunks contain no images.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from recordings.containers.container import LostMessage, RawMessage
from recordings.containers.opening import open_recording
from recordings.containers.time_range import TimeRange
from recordings.discovery.roles import TRANSFORMS
from recordings.encodings.decoding import decoder_of
from recordings.errors import LogError
from recordings.mcap.writer import MIN_OWN_CHUNK_BYTES, Ros2Writer, kind_of
from recordings.ros2.from_msg import frame_name

OWN_FRAME = "nav/"  # before the name of a camera in the results' tree, if the input has a transform to it
_COLLECTED_BYTES = 1024 * 1024


def copy_inputs(
    writer: Ros2Writer, logs: Path | Sequence[Path], start: float | None = None, end: float | None = None
) -> Counter[str]:
    """Copy the messages from `start` to before `end`, s after the first one, and all static transforms.

    Returns the reasons why messages could not be copied, with the number of times.
    """
    lost, small, size = Counter[str](), list[RawMessage](), 0
    with open_recording(logs) as log:
        part = TimeRange.after(log.start, start, end)
        static = {number for number, channel in log.channels.items() if channel.topic.endswith("tf_static")}
        ranges = [(static, None, None), (set(log.channels) - static, part.low, part.high)]
        kinds = {number: kind_of(channel) for number, channel in log.channels.items()}

        def add(messages: Sequence[RawMessage]) -> None:
            for message in messages:
                topic = log.channels[message.channel].topic
                writer.add(topic, kinds[message.channel], message.log_time, message.data, copy_of=message.channel)

        for channels, low, high in ranges:
            for item in log.messages(channels, low, high, allow_repeats=True):
                if isinstance(item, LostMessage):
                    lost[item.reason] += 1
                elif len(item.data) >= MIN_OWN_CHUNK_BYTES:
                    add([item])
                else:
                    small.append(item._replace(data=memoryview(bytes(item.data))))
                    size += len(item.data)
                if size >= _COLLECTED_BYTES:
                    add(small)
                    small, size = [], 0
        add(small)
    return lost


def parents_in(logs: Sequence[Path]) -> dict[str, str]:
    """The parent of each frame by the transforms in the logs, as far as they can be read."""
    parents: dict[str, str] = {}
    with open_recording(logs) as log:
        decoders = {}
        for number, channel in log.channels.items():
            with suppress(LogError):
                kind, decode = decoder_of(channel)
                if kind == TRANSFORMS:
                    decoders[number] = decode
        for item in log.messages(set(decoders), allow_repeats=True):
            with suppress(LogError):
                found = [] if isinstance(item, LostMessage) else decoders[item.channel](item.data).transforms
                parents |= {frame_name(each.child_frame_id): frame_name(each.header.frame_id) for each in found}
    return parents
