"""The messages of an MCAP file by their topics, decoded by the schemas that the file carries.

A message may have any fields, whatever its type's name: what cannot be made of one is an error of that message, said
like a broken one's, and never ends the reading.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any, TypeVar

import zstandard
from mcap.records import Channel

from recordings.errors import LogError, said
from recordings.mcap.file import CONVERT, McapFile
from recordings.mcap.index import Lost
from recordings.ros2.cdr import decoder_for, full_name, plain
from recordings.ros2.from_msg import frame_of

_PLACES = 4  # in a log, at which messages are looked at until one can be read: a filter may begin with nonsense
_LOOKED_AT = 20  # messages at most at each of them
_HEAD = 12  # bytes of a message that end with its header's stamp

Decoder = Callable[[bytes | memoryview], Any]
T = TypeVar("T")


class _GoneError(LogError):
    """A message that the file does not hold any more."""


class DecodedTopics:
    """The messages of a file; what is made of them comes as a LogError where nothing can be.

    decoders: by channel; sealed: channel -> why it cannot be decoded; schemas: topic that can be -> the full ROS 2 name
    of its type.
    """

    def __init__(self, file: McapFile) -> None:
        self.file = file
        self.decoders: dict[int, Decoder] = {}
        self.sealed: dict[int, str] = {}
        self.schemas: dict[str, str] = {}
        for number, channel in file.index.channels.items():
            try:
                self.decoders[number] = self._decoder(channel)
            except LogError as error:
                self.sealed[number] = str(error)

    def channels_of(self, topic: str) -> set[int]:
        """The channels of a topic that can be decoded."""
        return self.file.channels_of([topic]) & self.decoders.keys()

    def count(self, topic: str) -> int:
        """How many messages of a topic can be decoded, if they are whole."""
        return self.file.count(self.channels_of(topic))

    def each(
        self, topic: str, make: Callable[[Any], T], start: int | None = None, any_order: bool = False
    ) -> Iterator[T | LogError]:
        """What `make` makes of each message of a topic, from a log time on, ns."""
        for raw in self.file.messages(self.channels_of(topic), start, any_order=any_order):
            if not isinstance(raw, Lost):
                yield attempt(lambda data, decoder: make(decoder(data)), raw.data, self.decoders[raw.channel])
            elif raw.channel is not None:
                yield _GoneError(raw.reason)

    def some(self, topic: str, make: Callable[[Any], T]) -> Iterator[T | LogError]:
        """What `make` makes of some messages of a topic from all over the log that the file still holds."""
        for place in range(_PLACES):
            start = self.file.start + (self.file.end - self.file.start) * place // _PLACES
            made = self.each(topic, make, start, any_order=True)
            yield from islice((each for each in made if not isinstance(each, _GoneError)), _LOOKED_AT)

    def last(self, topic: str, make: Callable[[Any], T]) -> Iterator[T | LogError]:
        """What `make` makes of the last message of a topic, or of those that were logged with it."""
        return self.each(topic, make, max(self.file.times(self.channels_of(topic)).tolist(), default=None))

    def first(self, topic: str, make: Callable[[Any], T]) -> T | LogError:
        """What `make` makes of the first message of which it makes anything, else the LogError of the last."""
        made: T | LogError = LogError(f"{topic} has no messages")
        for made in self.each(topic, make):
            if not isinstance(made, LogError):
                return made
        return made

    def frame_of(self, topic: str) -> str:
        """The frame_id of a topic's first message, empty where it has none."""
        frame = self.first(topic, frame_of)
        return "" if isinstance(frame, LogError) else frame

    def _decoder(self, channel: Channel) -> Decoder:
        schema = self.file.schema(channel)
        if channel.message_encoding != "cdr":
            remedy = f"; convert the bag itself: {CONVERT}" if channel.message_encoding == "ros1" else ""
            raise LogError(f"its messages are in '{channel.message_encoding}', not in 'cdr' as those of ROS 2{remedy}")
        if schema is None:
            raise LogError("its messages have no schema")
        decoder = decoder_for(schema.name, schema.encoding, schema.data)
        self.schemas[channel.topic] = full_name(schema.name)
        return decoder


def attempt(make: Callable[..., T], *arguments: Any) -> T | LogError:
    """What `make` returns, or what it raises: foreign messages may fail a codec or a conversion in any way."""
    try:
        return make(*arguments)
    except LogError as error:
        return error
    except (AttributeError, TypeError) as error:
        return LogError(f"it is not what its type's name says ({said(error)})")
    except Exception as error:
        return LogError(said(error))


def peek_stamp(data: memoryview) -> int:
    """The stamp, ns, of a CDR message that begins with a std_msgs/Header, without decoding it; 0 if it is too short."""
    try:
        head = plain(data, _HEAD)
    except zstandard.ZstdError:
        return 0
    if len(head) < _HEAD:
        return 0
    seconds, nanoseconds = struct.unpack_from("<iI" if head[1] else ">iI", head, 4)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)
