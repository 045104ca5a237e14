"""The index of an MCAP file: where its chunks and messages are, and from what time.

`index_from_summary` reads it from a complete summary section; otherwise `recordings.mcap.walk` builds it. Only the walk
knows the time of every message.
"""

from __future__ import annotations

import os
import struct
from array import array
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import zstandard
from isal.isal_zlib import crc32
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer, Header, Schema, Statistics

from recordings.containers.container import LostMessage, RawMessage
from recordings.containers.finding import first_bytes
from recordings.containers.timeline import MAX_LOG_TIME
from recordings.errors import LogError, sentence_of

MAGIC = b"\x89MCAP0\r\n"
PARSE_ERRORS = (
    McapError, ValueError, struct.error, zstandard.ZstdError, RuntimeError, MemoryError, OverflowError, OSError,
)  # fmt: skip

RECORD = struct.Struct("<BQ")  # opcode, length
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_FOOTER_LENGTH = 20
_MAX_SUMMARY_BYTES = 1 << 30  # of a summary or header that is read
_UNCHECKED_BYTES = 1 << 16  # that are asked for without a look at the file's size, for speed
_TAIL = RECORD.size + _FOOTER_LENGTH + len(MAGIC)


@dataclass
class Index:
    """The index of a file.

    chunks: each with its channels (none listed: unknown); unchunked: the place, the offset and the size of the data,
    bytes, of the messages outside chunks; rescued: messages of a cut chunk, each with its place; lost: the damage
    found; stated_counts: messages by channel, stated_records: number of chunks, channels and schemas, both
    from the file's statistics. Of the messages counted so far, all with `walked`: counted_channels and counted_times:
    in file order; places: chunk offset -> the places of its messages; latest: the last log time, ns.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    unchunked: tuple[array[int], array[int], array[int]] = field(
        default_factory=lambda: (array("I"), array("Q"), array("I"))
    )
    rescued: list[tuple[int, RawMessage]] = field(default_factory=list)
    lost: list[LostMessage] = field(default_factory=list)
    counted_channels: array[int] = field(default_factory=lambda: array("H"))
    counted_times: array[int] = field(default_factory=lambda: array("Q"))
    places: dict[int, range] = field(default_factory=dict)
    stated_counts: dict[int, int] = field(default_factory=dict)
    stated_records: tuple[int, int, int] | None = None
    profile: str = ""
    walked: bool = False
    latest: int = 0

    def count_message(self, channel: int, log_time: int) -> int:
        """Count the next message of the file; returns its place."""
        self.counted_channels.append(channel)
        self.counted_times.append(log_time)
        if log_time <= MAX_LOG_TIME:
            self.latest = max(self.latest, log_time)
        return len(self.counted_times) - 1

    def define(self, opcode: int, content: bytes | memoryview) -> None:
        """Store a schema or a channel; other records are ignored."""
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(_stream(content))
            _check_read(schema, content)
            self.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(_stream(content))
            _check_read(channel, content)
            self.channels[channel.id] = channel

    def note_damage(self, reason: str, log_time: int | None = None) -> None:
        """Note damage whose messages are unknown. Without a log time it is placed after all messages so far."""
        self.lost.append(LostMessage(None, self.latest if log_time is None else log_time, reason))


def _check_read(record: Schema | Channel, content: bytes | memoryview) -> None:
    """Raise ValueError if a definition does not match its bytes: the reader accepts a cut string as a short one."""
    builder: Any = RecordBuilder()
    record.write(builder)
    written = builder.end()[RECORD.size :]
    if written != bytes(content[: len(written)]):  # padding may follow
        raise ValueError("a definition is cut short")


def opened(path: Path) -> BinaryIO:
    """The open file, if it begins like an MCAP file."""
    start = first_bytes(path, "a .mcap file")
    if not start.startswith(MAGIC):
        raise LogError(f"{path} is not an MCAP log (its first bytes differ); give a .mcap file")
    return path.open("rb")


def index_from_summary(file: BinaryIO, size: int) -> Index | None:
    """The index in the file's summary; None unless it surely describes the whole file."""
    index = read_summary(file, size)
    if index is None or index.stated_records is None:
        return None
    chunks, channels, schemas = index.stated_records
    whole = (
        chunks == len(index.chunks) > 0
        and index.stated_counts  # statistics may leave these counts out
        and channels == len(index.channels)
        and schemas == len(index.schemas)
        and all(chunk.message_index_offsets.keys() <= index.channels.keys() for chunk in index.chunks)
    )
    if not whole:
        return None
    with suppress(*PARSE_ERRORS):  # a log without its header can still be read
        _, length = RECORD.unpack(read_at(file, len(MAGIC), RECORD.size))
        index.profile = profile_of(read_at(file, len(MAGIC) + RECORD.size, min(length, _MAX_SUMMARY_BYTES)))
    return index


def profile_of(content: bytes) -> str:
    """The profile in a header record."""
    return str(Header.read(_stream(content)).profile)


def read_summary(file: BinaryIO, size: int) -> Index | None:
    """The content of the summary section; None if there is none or its CRC does not match."""
    if size < len(MAGIC) + _TAIL:
        return None
    tail = read_at(file, size - _TAIL, _TAIL)
    if tail[-len(MAGIC) :] != MAGIC or RECORD.unpack_from(tail) != (Opcode.FOOTER, _FOOTER_LENGTH):
        return None
    footer = Footer.read(_stream(tail[RECORD.size : -len(MAGIC)]))
    if not len(MAGIC) < footer.summary_start < size - _TAIL:
        return None
    length = size - _TAIL - footer.summary_start
    if length > _MAX_SUMMARY_BYTES:
        return None
    section = read_at(file, footer.summary_start, length)
    if footer.summary_crc and crc32(tail[: RECORD.size + 16], crc32(section)) != footer.summary_crc:
        return None
    index = Index()
    try:
        for opcode, content in iter_records(section):
            if opcode == Opcode.CHUNK_INDEX:
                index.chunks.append(ChunkIndex.read(_stream(content)))
            elif opcode == Opcode.STATISTICS:
                statistics = Statistics.read(_stream(content))
                index.stated_records = statistics.chunk_count, statistics.channel_count, statistics.schema_count
                index.stated_counts = dict(statistics.channel_message_counts)
            else:
                index.define(opcode, content)
    except PARSE_ERRORS:
        return None
    return index


def read_at(file: BinaryIO, offset: int, size: int) -> bytes:
    """At most `size` bytes from `offset`, past the buffer and position of `file`; none beyond its end."""
    number = file.fileno()
    if size > _UNCHECKED_BYTES or offset >= 1 << 62:  # damaged ones may be huge
        size = min(size, max(0, os.fstat(number).st_size - offset))
    found = os.pread(number, size, offset) if size > 0 else b""
    while len(found) < size and (more := os.pread(number, size - len(found), offset + len(found))):
        found += more
    return found


def iter_records(section: bytes | memoryview, whole: bool = True) -> Iterator[tuple[int, memoryview]]:
    """(opcode, content) of each record of a section. A cut record raises ValueError; without `whole` it is left out."""
    view, position = memoryview(section), 0
    while position < len(view):
        after = position + RECORD.size
        length = RECORD.unpack_from(view, position)[1] if after <= len(view) else len(view)
        if after + length > len(view):
            if whole:
                raise ValueError("a record is longer than its section")
            return
        yield view[position], view[after : after + length]
        position = after + length


def parse_message(content: memoryview) -> RawMessage:
    """The message in a message record."""
    channel, _, log_time, _ = MESSAGE.unpack_from(content)
    return RawMessage(channel, log_time, content[MESSAGE.size :])


def lost_chunk(offset: int, error: Exception) -> str:
    """The sentence for a chunk that cannot be unpacked."""
    return f"the chunk at byte {offset} is broken and its messages are lost ({sentence_of(error)})"


def _stream(content: bytes | memoryview) -> ReadDataStream:
    return ReadDataStream(BytesIO(content))
