"""A file with messages. A container says how messages are encoded; it does not decode them.

To read another format, write a subclass of `Container` and name it in `opening.py`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sized
from dataclasses import dataclass
from heapq import merge
from operator import attrgetter
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from recordings.containers.timeline import Places, Timeline
from recordings.errors import LogError

HEAD_BYTES = 64  # of a message; they contain the stamp of its header
MAX_STORED_BYTES = 1 << 27  # of a message as stored; 21 million pixels in colour have half of it
MAX_OPEN_BYTES = 1 << 27  # of unpacked chunks that overlap in time, while another one is unpacked
_READ_AT_ONCE = 10_000  # places


class RawMessage(NamedTuple):
    """One message as stored. log_time: ns; data: its bytes."""

    channel: int
    log_time: int
    data: memoryview


class LostMessage(NamedTuple):
    """One or more messages that cannot be read. channel: None if unknown; log_time: ns, of the first."""

    channel: int | None
    log_time: int
    reason: str


@dataclass(frozen=True)
class MessageSchema:
    """The type of a channel's messages.

    name: as the file has it; encoding: of the text (ros2msg, ros2idl, ros1msg, protobuf, jsonschema); text: the
    definition, empty if the file has none.
    """

    name: str
    encoding: str
    text: bytes


@dataclass(frozen=True)
class Channel:
    """A numbered channel. message_encoding: cdr, ros1, protobuf, json; schema: None if the file has none."""

    number: int
    topic: str
    message_encoding: str
    schema: MessageSchema | None


class Container(ABC):
    """A file open for reading.

    path: the file; size: bytes; start, end: log time of the first and the last message, ns; channels: by number;
    timeline: channel and log time of every message, in file order; lost: the damage; profile: that an MCAP file states;
    indexed: whether the file has a valid index; otherwise it was read through.
    """

    path: Path
    size: int
    start: int
    end: int
    channels: Mapping[int, Channel]
    timeline: Timeline
    lost: list[LostMessage]
    profile: str
    indexed: bool

    def messages(
        self, channels: set[int], start: int | None = None, end: int | None = None
    ) -> Iterator[RawMessage | LostMessage]:
        """The messages of `channels` with start <= log time < end, ns, in log-time order (ties: in file order).

        A `LostMessage` stands at the log time of lost messages; if that time is unknown, at the end.
        """
        found = self.read(self.timeline.chosen(channels, start, end))
        lost = within(self.losses(channels), start, end)
        return merge(found, lost, key=log_time_of) if lost else found

    def losses(self, channels: set[int]) -> list[LostMessage]:
        """The damage of some channels or of unknown ones, and their messages whose log time is damaged."""
        why, untimed = "the message is lost: its log time is damaged", self.timeline.untimed
        found = [*self.lost, *(LostMessage(channel, self.end, why) for channel in untimed)]
        return [item for item in found if item.channel is None or item.channel in channels]

    def heads(self, channels: set[int]) -> Iterator[RawMessage | LostMessage]:
        """At least the first bytes of the messages of `channels`, with their headers, in any order and not verified."""
        return self.messages(channels)

    def count(self, channels: set[int]) -> int:
        """The number of messages in some channels."""
        return self.timeline.count(channels)

    @abstractmethod
    def close(self) -> None:
        """Close the file."""

    @abstractmethod
    def read(self, places: Places) -> Iterator[RawMessage | LostMessage]:
        """The messages at some places of the timeline, in that order."""

    def _read_each(
        self, places: Places, content: Callable[[int], memoryview | str]
    ) -> Iterator[RawMessage | LostMessage]:
        """The messages at some places. content: place -> the bytes of its message, or why it is lost."""
        for block in blocks(places):
            columns = block, self.timeline.channels[block], self.timeline.log_times[block]
            for place, channel, log_time in zip(*(column.tolist() for column in columns), strict=True):
                found = content(place)
                if isinstance(found, str):
                    yield LostMessage(channel, log_time, found)
                else:
                    yield RawMessage(channel, log_time, found)

    def _ends(self, why: str = "") -> tuple[int, int]:
        """The log time of the first and the last message. Raises LogError if there is none; `why` may be known."""
        times = self.timeline.log_times[self.timeline.log_times >= 0]
        if not times.size:
            damage = f" that can be read: {self.lost[0].reason}" if self.lost else "; record it again"
            raise LogError(f"{self.path} contains no messages{why or damage}")
        return int(np.min(times)), int(np.max(times))


log_time_of = attrgetter("log_time")


def within(lost: Iterable[LostMessage], start: int | None, end: int | None) -> list[LostMessage]:
    """The losses with start <= log time < end, ns, by log time."""
    high = 1 << 64 if end is None else end
    return sorted((item for item in lost if (start or 0) <= item.log_time < high), key=log_time_of)


def blocks(places: Places) -> Iterator[Places]:
    """Some places after the others, as a list of Python's numbers takes more memory than an array."""
    return (places[first : first + _READ_AT_ONCE] for first in range(0, len(places), _READ_AT_ONCE))


Chunk = TypeVar("Chunk", bound=Sized)


class OpenChunks(Generic[Chunk]):
    """The unpacked chunks of messages that are read one after the other.

    A chunk is let go after its last message. Beyond `MAX_OPEN_BYTES` the one unpacked first is, and is unpacked again
    when due. due: the number of the chunk of each message.
    """

    def __init__(self, due: NDArray[np.integer[Any]], unpack: Callable[[int], Chunk]) -> None:
        self._unpack, self._due = unpack, np.bincount(due)
        self._open: dict[int, Chunk] = {}

    def of_next(self, number: int) -> Chunk:
        """The chunk of the next message."""
        if number not in self._open:
            while sum(map(len, self._open.values())) > MAX_OPEN_BYTES:
                del self._open[next(iter(self._open))]
            self._open[number] = self._unpack(number)
        found = self._open[number]
        self._due[number] -= 1
        if not self._due[number]:
            del self._open[number]
        return found
