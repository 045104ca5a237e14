"""What lies where in an MCAP file, and from when: found from its summary, where that is whole (else `mcap_walk` does).

Both ways fill an `Index`; only the walk knows the time of every message.
"""

from __future__ import annotations

import os
import struct
from array import array
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any, BinaryIO, NamedTuple, TypeVar

import zstandard
from isal.isal_zlib import crc32
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer, Header, Schema, Statistics

MAGIC = b"\x89MCAP0\r\n"
BROKEN = (McapError, ValueError, struct.error, zstandard.ZstdError, RuntimeError, MemoryError, OverflowError, OSError)

LAST_TIME = (1 << 63) - 1  # ns; a log time after it is damage, which no clock can show
SETTLED = 1_000_000_000  # ns; stamps are before log times: so much later none is of before the clock was set back
LEAP = 10_000_000_000  # ns; a message that is so far ahead of those before and behind it is damage, no clock's doing
JITTER = 100_000_000  # ns; messages of a channel may be logged in another order than they were written by so much

RECORD = struct.Struct("<BQ")  # opcode, length
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_FOOTER_LENGTH = 20
_SECTION = 1 << 30  # bytes; of a longer summary, or header, not all is read
_TAIL = RECORD.size + _FOOTER_LENGTH + len(MAGIC)


T = TypeVar("T", "Raw", "Loose")


class Raw(NamedTuple):
    """One message as it lies in the file. log_time: ns; data: its bytes, a view of the chunk it came in."""

    channel: int
    log_time: int
    data: memoryview


class Clock(NamedTuple):
    """The recorder's clock as a message shows it, and those of its channel that precede it in the file.

    latest: the latest log time of them, ns; back: by how much the clock was set back, ns, until it is `SETTLED` beyond
    that time (then 0); before: the latest without the last of them.
    """

    latest: int = 0
    back: int = 0
    before: int = 0

    def then(self, log_time: int) -> Clock:
        """The clock as the next message shows it."""
        if log_time > LAST_TIME:
            return self
        fall = self.latest - log_time
        if fall <= (-SETTLED if self.back else JITTER):
            return Clock(max(self.latest, log_time), 0, self.latest)
        if not self.back and self.before < log_time and self.latest - self.before > LEAP:  # the last one is wrong
            return Clock(log_time, 0, self.before)
        return Clock(self.latest, max(self.back, fall), self.before)


class Lost(NamedTuple):
    """Messages that are gone: of which channel (None: not known), from when (log time, ns), and why."""

    channel: int | None
    log_time: int
    reason: str


class Loose(NamedTuple):
    """Where a message outside the chunks lies: its data's offset and size, bytes."""

    channel: int
    log_time: int
    offset: int
    size: int


@dataclass
class Index:
    """Where things are in a file.

    chunks: with the channels that each holds (none listed: not known); rescued: messages of a chunk that is cut, each
    with its clock; lost: what is damaged; expected: how many messages the file's own statistics count by channel;
    counts: of chunks, channels and schemas, by the same. Filled only where the file was `walked`: times: log times by
    channel, in file order; clocks: by channel; before: offset of a chunk -> what `clocks` were where it begins.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    loose: list[Loose] = field(default_factory=list)
    rescued: list[tuple[Raw, Clock]] = field(default_factory=list)
    lost: list[Lost] = field(default_factory=list)
    times: dict[int, array[int]] = field(default_factory=dict)
    clocks: dict[int | None, Clock] = field(default_factory=lambda: defaultdict(Clock))
    before: dict[int, dict[int | None, Clock]] = field(default_factory=dict)
    expected: dict[int, int] = field(default_factory=dict)
    counts: tuple[int, int, int] | None = None
    profile: str = ""
    walked: bool = False
    latest: int = 0  # the last log time seen, ns

    def seen(self, channel: int, log_time: int) -> Clock:
        """Count one message; returns the clock of its channel."""
        self.times.setdefault(channel, array("Q")).append(log_time)
        clock = self.clocks[channel] = self.clocks[channel].then(log_time)
        self.latest = max(self.latest, clock.latest)
        return clock

    def define(self, opcode: int, content: bytes | memoryview) -> None:
        """Take note of a schema or channel; other records do not matter."""
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(_stream(content))
            _check_read(schema, content)
            self.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(_stream(content))
            _check_read(channel, content)
            self.channels[channel.id] = channel

    def lose(self, reason: str, log_time: int | None = None) -> None:
        """Note damage whose messages are not known; without a time, behind all that was seen."""
        self.lost.append(Lost(None, self.latest if log_time is None else log_time, reason))


def _check_read(record: Schema | Channel, content: bytes | memoryview) -> None:
    """Raise ValueError if a definition is not what its bytes say: the reader takes a cut string for a short one."""
    builder: Any = RecordBuilder()
    record.write(builder)
    written = builder.end()[RECORD.size :]
    if written != bytes(content[: len(written)]):  # padding may follow
        raise ValueError("a definition that ends before its time")


def from_summary(file: BinaryIO, size: int) -> Index | None:
    """The index that the file carries itself, or None where it has none that is sure to describe the whole file."""
    index = summary(file, size)
    if index is None or index.counts is None:
        return None
    chunks, channels, schemas = index.counts
    whole = (
        chunks == len(index.chunks) > 0
        and index.expected  # statistics may leave these counts out
        and channels == len(index.channels)
        and schemas == len(index.schemas)
        and all(chunk.message_index_offsets.keys() <= index.channels.keys() for chunk in index.chunks)
    )
    if not whole:
        return None
    with suppress(*BROKEN):  # without its header a log can be read as well
        _, length = RECORD.unpack(read(file, len(MAGIC), RECORD.size))
        index.profile = profile_of(read(file, len(MAGIC) + RECORD.size, min(length, _SECTION)))
    return index


def profile_of(content: bytes) -> str:
    """The profile that a header record names."""
    return str(Header.read(_stream(content)).profile)


def summary(file: BinaryIO, size: int) -> Index | None:
    """What the summary section says, None where there is none or its CRC does not match."""
    if size < len(MAGIC) + _TAIL:
        return None
    tail = read(file, size - _TAIL, _TAIL)
    if tail[-len(MAGIC) :] != MAGIC or RECORD.unpack_from(tail) != (Opcode.FOOTER, _FOOTER_LENGTH):
        return None
    footer = Footer.read(_stream(tail[RECORD.size : -len(MAGIC)]))
    if not len(MAGIC) < footer.summary_start < size - _TAIL:
        return None
    length = size - _TAIL - footer.summary_start
    if length > _SECTION:
        return None
    section = read(file, footer.summary_start, length)
    if footer.summary_crc and crc32(tail[: RECORD.size + 16], crc32(section)) != footer.summary_crc:
        return None
    index = Index()
    try:
        for opcode, content in records(section):
            if opcode == Opcode.CHUNK_INDEX:
                index.chunks.append(ChunkIndex.read(_stream(content)))
            elif opcode == Opcode.STATISTICS:
                statistics = Statistics.read(_stream(content))
                index.counts = statistics.chunk_count, statistics.channel_count, statistics.schema_count
                index.expected = dict(statistics.channel_message_counts)
            else:
                index.define(opcode, content)
    except BROKEN:
        return None
    return index


def read(file: BinaryIO, offset: int, size: int) -> bytes:
    """At most `size` bytes from `offset`; none where the file does not reach so far."""
    there = os.fstat(file.fileno()).st_size - offset
    if there <= 0:
        return b""
    file.seek(offset)
    return file.read(min(size, there))


def records(section: bytes, whole: bool = True) -> Iterator[tuple[int, memoryview]]:
    """(opcode, content) of the records of a section. One that ends early raises, or with `whole` off is left out."""
    view, position = memoryview(section), 0
    while position < len(view):
        after = position + RECORD.size
        length = RECORD.unpack_from(view, position)[1] if after <= len(view) else len(view)
        if after + length > len(view):
            if whole:
                raise ValueError("a record ends behind its section")
            return
        yield view[position], view[after : after + length]
        position = after + length


def raw(content: memoryview) -> Raw:
    """The message of a message record."""
    channel, _, log_time, _ = MESSAGE.unpack_from(content)
    return Raw(channel, log_time, content[MESSAGE.size :])


def in_order(message: T, clocks: Iterable[Clock]) -> T | Lost:
    """A message, as a `Lost` if by one of the clocks the time at which it was logged had been before."""
    fall = max((clock.back for clock in clocks if clock.back and message.log_time < clock.latest + SETTLED), default=0)
    if not fall:
        return message
    back = f"by {fall / 1e9:.3g} s or more, and was not yet 1 s beyond where it had been"
    remedy = "if no clock was set and the log is only written in another order, `mcap sort` mends it"
    return Lost(message.channel, message.log_time, f"the log's clock was set back {back}; {remedy}")


def _stream(content: bytes | memoryview) -> ReadDataStream:
    return ReadDataStream(BytesIO(content))
