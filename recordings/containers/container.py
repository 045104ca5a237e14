"""What the source needs of a file with messages. A container says how messages are encoded; it does not decode them.

To read another format, write a class with the members of `Container` and name it in `opening.py`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

from recordings.containers.timeline import Timeline


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


class Container(Protocol):
    """A file open for reading.

    path: the file; size: bytes; start, end: log time of the first and the last message, ns.
    """

    path: Path
    size: int
    start: int
    end: int

    @property
    def channels(self) -> Mapping[int, Channel]:
        """The channels by number."""

    @property
    def lost(self) -> Sequence[LostMessage]:
        """The damage known so far."""

    @property
    def profile(self) -> str:
        """The profile that an MCAP file states."""

    @property
    def indexed(self) -> bool:
        """Whether the file has a valid index; otherwise it was read through."""

    @property
    def timeline(self) -> Timeline:
        """Channel and log time of every message, in file order."""

    def messages(
        self, channels: set[int], start: int | None = None, end: int | None = None, places: range | None = None
    ) -> Iterator[RawMessage | LostMessage]:
        """The messages of `channels` with start <= log time < end, ns, in log-time order.

        A `LostMessage` stands at the log time of lost messages; if that time is unknown, at the end. places: of the
        messages in the timeline; None: all.
        """

    def heads(self, channels: set[int]) -> Iterator[RawMessage | LostMessage]:
        """At least the first bytes of the messages of `channels`, with their headers, in any order and not verified."""

    def count(self, channels: set[int]) -> int:
        """The number of messages in some channels."""

    def close(self) -> None:
        """Close the file."""
