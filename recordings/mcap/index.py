"""The index of an MCAP file: its chunks, and the channel and log time of every message.

`index_from_summary` reads it from a complete summary section; otherwise `recordings.mcap.walk` builds it.
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
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import zstandard
from isal.isal_zlib import crc32
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer, Header, Schema, Statistics
from numpy.typing import NDArray

from recordings.containers.container import LostMessage
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
_MAX_SECTION_BYTES = 1 << 28  # of the message index of a chunk
_UNCHECKED_BYTES = 1 << 16  # that are asked for without a look at the file's size, for speed
_TAIL = RECORD.size + _FOOTER_LENGTH + len(MAGIC)


class StoredChunk(NamedTuple):
    """Where messages are.

    offset, length: of the chunk record, bytes; places: of its messages in the timeline; unpacked: bytes of its records;
    index_length: of the message index after it, bytes; is_cut: its end is missing; is_bare: messages outside chunks.
    """

    offset: int
    length: int
    places: range
    unpacked: int
    index_length: int = 0
    is_cut: bool = False
    is_bare: bool = False


@dataclass
class Index:
    """The index of a file.

    chunks: in file order; message_channels, message_times: of every message, in file order; lost: the damage found;
    stated_counts: messages by channel, by the file's statistics; latest: the last log time so far, ns.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[StoredChunk] = field(default_factory=list)
    message_channels: array[int] = field(default_factory=lambda: array("H"))
    message_times: array[int] = field(default_factory=lambda: array("Q"))
    lost: list[LostMessage] = field(default_factory=list)
    stated_counts: dict[int, int] = field(default_factory=dict)
    profile: str = ""
    walked: bool = False
    latest: int = 0

    def add(self, offset: int, length: int, unpacked: int, channels: Any, times: Any, **kind: Any) -> None:
        """Add the next messages of the file, in a chunk or outside.

        channels, times: arrays of 16 and 64 bits; the rest: fields of `StoredChunk`.
        """
        first, times = len(self.message_times), np.asarray(times, np.uint64)
        self.message_channels.frombytes(channels.tobytes())
        self.message_times.frombytes(times.tobytes())
        self.latest = max(self.latest, int(np.max(times[times <= MAX_LOG_TIME], initial=0)))
        self.chunks.append(StoredChunk(offset, length, range(first, len(self.message_times)), unpacked, **kind))

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
        self.lost.append(LostMessage(None, self.latest if log_time is None else min(log_time, MAX_LOG_TIME), reason))

    def counts(self) -> dict[int, int]:
        """The number of messages by channel."""
        counts = np.bincount(np.asarray(self.message_channels, np.uint16))
        return {int(number): int(counts[number]) for number in np.flatnonzero(counts)}


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
    """The index by the file's summary and message indexes; None unless it surely describes the whole file."""
    summary = read_summary(file, size)
    if summary is None:
        return None
    index, chunks, statistics = summary
    whole = (
        statistics is not None
        and statistics.chunk_count == len(chunks) > 0
        and statistics.channel_count == len(index.channels)
        and statistics.schema_count == len(index.schemas)
    )
    if not whole:
        return None
    for chunk in sorted(chunks, key=lambda chunk: chunk.chunk_start_offset):
        offset, length, index_length = chunk.chunk_start_offset, chunk.chunk_length, chunk.message_index_length
        channels, times, _ = message_index(file, offset + length, index_length)
        ends = chunk.message_start_time, chunk.message_end_time
        if len(times) and (int(np.min(times)), int(np.max(times))) != ends:  # no CRC covers the message index
            return None
        index.add(offset, length, chunk.uncompressed_size, channels, times, index_length=index_length)
    stated = {channel: count for channel, count in index.stated_counts.items() if count}
    if not stated or index.counts() != stated or not stated.keys() <= index.channels.keys():
        return None
    if max(index.message_times) > MAX_LOG_TIME:
        return None
    with suppress(*PARSE_ERRORS):  # a log without its header can still be read
        _, length = RECORD.unpack(read_at(file, len(MAGIC), RECORD.size))
        index.profile = profile_of(read_at(file, len(MAGIC) + RECORD.size, min(length, _MAX_SUMMARY_BYTES)))
    return index


def message_index(
    file: BinaryIO, position: int, length: int
) -> tuple[NDArray[np.uint16], NDArray[np.uint64], NDArray[np.uint64]]:
    """Channel, log time and offset of each message of a chunk, in file order; empty without a message index."""
    channels, entries = [np.zeros(0, np.uint16)], [np.zeros((0, 2), np.uint64)]
    section = read_at(file, position, min(length, _MAX_SECTION_BYTES))
    with suppress(*PARSE_ERRORS):
        for opcode, content in iter_records(section):
            if opcode == Opcode.MESSAGE_INDEX:
                channel, size = struct.unpack_from("<HI", content)
                entries.append(np.frombuffer(content, "<u8", size // 16 * 2, 6).reshape(-1, 2))
                channels.append(np.full(len(entries[-1]), channel, np.uint16))
    times, offsets = np.concatenate(entries).T
    order = np.argsort(offsets, kind="stable")
    return np.concatenate(channels)[order], times[order], offsets[order]


def profile_of(content: bytes) -> str:
    """The profile in a header record."""
    return str(Header.read(_stream(content)).profile)


def read_summary(file: BinaryIO, size: int) -> tuple[Index, list[ChunkIndex], Statistics | None] | None:
    """The summary section, its definitions in an index; None if it is not there or its CRC does not match."""
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
    index, chunks, statistics = Index(), list[ChunkIndex](), None
    try:
        for opcode, content in iter_records(section):
            if opcode == Opcode.CHUNK_INDEX:
                chunks.append(ChunkIndex.read(_stream(content)))
            elif opcode == Opcode.STATISTICS:
                statistics = Statistics.read(_stream(content))
                index.stated_counts = dict(statistics.channel_message_counts)
            else:
                index.define(opcode, content)
    except PARSE_ERRORS:
        return None
    return index, chunks, statistics


def read_at(file: BinaryIO, offset: int, size: int) -> bytes:
    """At most `size` bytes from `offset`, past the buffer and position of `file`; none beyond its end."""
    number = file.fileno()
    if size > _UNCHECKED_BYTES or offset >= 1 << 62:  # damaged ones may be huge
        size = min(size, max(0, os.fstat(number).st_size - offset))
    found = os.pread(number, size, offset) if size > 0 else b""
    while len(found) < size and (more := os.pread(number, size - len(found), offset + len(found))):
        found += more
    return found


def iter_records(section: bytes | memoryview, is_cut: bool = False) -> Iterator[tuple[int, memoryview]]:
    """(opcode, content) of each record of a section. A cut record raises ValueError, or is left out if `is_cut`."""
    view, position = memoryview(section), 0
    while position < len(view):
        after = position + RECORD.size
        length = RECORD.unpack_from(view, position)[1] if after <= len(view) else len(view)
        if after + length > len(view):
            if is_cut:
                return
            raise ValueError("a record is longer than its section")
        yield view[position], view[after : after + length]
        position = after + length


def lost_chunk(offset: int, error: Exception) -> str:
    """The sentence for a chunk that cannot be unpacked."""
    return f"the chunk at byte {offset} is broken and its messages are lost ({sentence_of(error)})"


def _stream(content: bytes | memoryview) -> ReadDataStream:
    return ReadDataStream(BytesIO(content))
