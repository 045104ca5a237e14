"""Finds where the messages of an MCAP file are: from its summary where that is whole, else by walking all of it once.

Both ways give the same `Index`, so reading knows one way only. The walk goes on behind a broken chunk, rescues what a
cut one still holds, and notes each loss.
"""

from __future__ import annotations

import struct
import zlib
from array import array
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any, BinaryIO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer, Header, Schema, Statistics

MAGIC = b"\x89MCAP0\r\n"
BROKEN = (McapError, ValueError, struct.error, zstandard.ZstdError, RuntimeError, MemoryError, OverflowError)

RECORD = struct.Struct("<BQ")  # opcode, length
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK = struct.Struct("<QQQII")  # start time, end time, size, CRC, length of the compression's name
_FOOTER_LENGTH = 20
_PRIVATE = 0x80  # from here on, opcodes are free for private use
_TAIL = RECORD.size + _FOOTER_LENGTH + len(MAGIC)


class Raw(NamedTuple):
    """One message as it lies in the file. log_time: ns; data: its bytes, a view of the chunk it came in."""

    channel: int
    log_time: int
    data: memoryview


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

    chunks: with the channels that each holds (none listed: not known); rescued: messages of a chunk that is cut; lost:
    what is damaged; times: log times by channel, filled only where the file was `walked`; expected: how many messages
    the file's own statistics count by channel; counts: of chunks, channels and schemas, by the same.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    loose: list[Loose] = field(default_factory=list)
    rescued: list[Raw] = field(default_factory=list)
    lost: list[Lost] = field(default_factory=list)
    times: dict[int, array[int]] = field(default_factory=dict)
    expected: dict[int, int] = field(default_factory=dict)
    counts: tuple[int, int, int] | None = None
    profile: str = ""
    walked: bool = False

    def seen(self, channel: int, log_time: int) -> None:
        """Count one message."""
        self.times.setdefault(channel, array("Q")).append(log_time)

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
        latest = max((max(times) for times in self.times.values()), default=0)
        self.lost.append(Lost(None, latest if log_time is None else log_time, reason))


def _check_read(record: Schema | Channel, content: bytes | memoryview) -> None:
    """Raise ValueError if a definition is not what its bytes say: the reader takes a cut string for a short one."""
    builder: Any = RecordBuilder()
    record.write(builder)
    written = builder.end()[RECORD.size :]
    if written != bytes(content[: len(written)]):  # padding may follow
        raise ValueError("a definition that ends before its time")


def from_summary(file: BinaryIO, size: int) -> Index | None:
    """The index that the file carries itself, or None where it has none that is sure to describe the whole file."""
    index = _summary(file, size)
    if index is None or index.counts is None:
        return None
    chunks, channels, schemas = index.counts
    whole = (
        chunks == len(index.chunks) > 0
        and channels == len(index.channels)
        and schemas == len(index.schemas)
        and all(chunk.message_index_offsets.keys() <= index.channels.keys() for chunk in index.chunks)
    )
    if not whole:
        return None
    with suppress(*BROKEN):  # without its header a log can be read as well
        _, length = RECORD.unpack(read(file, len(MAGIC), RECORD.size))
        index.profile = Header.read(_stream(read(file, len(MAGIC) + RECORD.size, min(length, size)))).profile
    return index


def _summary(file: BinaryIO, size: int) -> Index | None:
    """What the summary section says, None where there is none or its CRC does not match."""
    if size < len(MAGIC) + _TAIL:
        return None
    tail = read(file, size - _TAIL, _TAIL)
    if tail[-len(MAGIC) :] != MAGIC or RECORD.unpack_from(tail) != (Opcode.FOOTER, _FOOTER_LENGTH):
        return None
    footer = Footer.read(_stream(tail[RECORD.size : -len(MAGIC)]))
    if not len(MAGIC) < footer.summary_start < size - _TAIL:
        return None
    section = read(file, footer.summary_start, size - _TAIL - footer.summary_start)
    if footer.summary_crc and zlib.crc32(tail[: RECORD.size + 16], zlib.crc32(section)) != footer.summary_crc:
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


def walk(file: BinaryIO, size: int) -> Index:
    """The index of a file that carries none, or a broken one, from its data section."""
    index = Index(walked=True)
    if summary := _summary(file, size):
        index.expected = summary.expected
    checksum, position, before = zlib.crc32(MAGIC), len(MAGIC), 0
    while True:
        head = read(file, position, RECORD.size)
        opcode, length = RECORD.unpack(head) if len(head) == RECORD.size else (0, 0)
        content = read(file, position + RECORD.size, min(length, size))
        if opcode == 0 or len(content) < length:
            _note_cut(index, opcode, content, position, size)
            return index
        if opcode == Opcode.DATA_END and 4 <= length < MESSAGE.size:  # a longer one was once something else
            if struct.unpack_from("<I", content)[0] not in (0, checksum):
                index.lose("the CRC of the data section does not match: messages in it were changed, not known which")
            return index
        try:
            _note(index, opcode, content, position, before)
        except BROKEN as error:
            index.lose(f"the record at byte {position} is broken ({said(error)})")
        checksum = zlib.crc32(content, zlib.crc32(head, checksum))
        position, before = position + RECORD.size + length, opcode


def _note(index: Index, opcode: int, content: bytes, position: int, before: int) -> None:
    """Take note of one record of the data section. before: the opcode of the one before it.

    A record that cannot be where it is was something else before it was damaged, perhaps messages: that raises.
    """
    if opcode == Opcode.CHUNK:
        _note_chunk(index, content, position)
    elif opcode == Opcode.MESSAGE:
        channel, _, log_time, _ = MESSAGE.unpack_from(content)
        start = position + RECORD.size + MESSAGE.size
        index.loose.append(Loose(channel, log_time, start, len(content) - MESSAGE.size))
        index.seen(channel, log_time)
    elif opcode == Opcode.HEADER and before == 0:
        index.profile = Header.read(_stream(content)).profile
    elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
        index.define(opcode, content)
    elif opcode == Opcode.MESSAGE_INDEX:
        (listed,) = struct.unpack_from("<I", content, 2)
        if before not in (Opcode.CHUNK, Opcode.MESSAGE_INDEX) or listed % 16 or listed > len(content) - 6:
            raise ValueError("a message index without its chunk")
    elif opcode not in (Opcode.ATTACHMENT, Opcode.METADATA) and opcode < _PRIVATE:
        raise ValueError(f"a record of kind {opcode} has no place there")


def _note_chunk(index: Index, content: bytes, position: int) -> None:
    try:
        inside = list(records(unpacked(content)))
    except BROKEN as error:
        start = _CHUNK.unpack_from(content)[0]
        index.lose(f"the chunk at byte {position} is broken and its messages are lost ({said(error)})", start)
        return
    offsets, times = {}, []
    for opcode, record in inside:
        if opcode == Opcode.MESSAGE:
            channel, _, log_time, _ = MESSAGE.unpack_from(record)
            offsets[channel] = 0
            times.append(log_time)
            index.seen(channel, log_time)
        else:
            index.define(opcode, record)
    if times:
        chunk = ChunkIndex(
            chunk_length=RECORD.size + len(content), chunk_start_offset=position, compression="", compressed_size=0,
            message_end_time=max(times), message_index_length=0, message_index_offsets=offsets,
            message_start_time=min(times), uncompressed_size=0,
        )  # fmt: skip
        index.chunks.append(chunk)


def _note_cut(index: Index, opcode: int, content: bytes, position: int, size: int) -> None:
    """Rescue what a cut chunk still holds, and note the cut."""
    if opcode == Opcode.CHUNK:
        with suppress(*BROKEN):  # nothing more is to be had then
            for inner, record in records(_unpacked_start(content), whole=False):
                if inner == Opcode.MESSAGE:
                    index.rescued.append(raw(record))
                    index.seen(index.rescued[-1].channel, index.rescued[-1].log_time)
                else:
                    index.define(inner, record)
    count = sum(map(len, index.times.values()))
    index.lose(f"the log is cut or damaged at byte {position} of {size}; {count} messages were read before that")


def read(file: BinaryIO, offset: int, size: int) -> bytes:
    """At most `size` bytes from `offset`."""
    file.seek(offset)
    return file.read(size)


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


def unpacked(content: bytes) -> bytes:
    """The records of a chunk record, decompressed, size and CRC checked."""
    _, _, size, checksum, _ = _CHUNK.unpack_from(content)
    compression, packed, length = _packed(content)
    if len(packed) != length:
        raise ValueError(f"{len(packed)} of {length} bytes are there")
    if compression == "zstd":
        data = zstandard.decompress(packed, size) if size else b""
    elif compression == "lz4":
        data = bytes(lz4.frame.decompress(packed))
    elif not compression:
        data = bytes(packed)
    else:
        raise ValueError(f"compression '{compression}' is not known, only zstd, lz4 and none are")
    if len(data) != size:
        raise ValueError(f"it unpacks to {len(data)} bytes, not {size}")
    if checksum and zlib.crc32(data) != checksum:
        raise ValueError("its CRC does not match")
    return data


def _unpacked_start(content: bytes) -> bytes:
    """As much of a cut chunk as can still be decompressed; there is no CRC for a part."""
    compression, packed, _ = _packed(content)
    if compression == "zstd":
        return bytes(zstandard.ZstdDecompressor().decompressobj().decompress(packed))
    if compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed))
    return b"" if compression else bytes(packed)


def _packed(content: bytes) -> tuple[str, memoryview, int]:
    """Compression, the compressed bytes, and how many they should be."""
    name_end = _CHUNK.size + _CHUNK.unpack_from(content)[-1]
    (length,) = struct.unpack_from("<Q", content, name_end)
    view = memoryview(content)
    return str(view[_CHUNK.size : name_end], "utf-8"), view[name_end + 8 : name_end + 8 + length], length


def said(error: BaseException) -> str:
    """The first line of what an exception says."""
    return str(error).split("\n")[0] or type(error).__name__


def _stream(content: bytes | memoryview) -> ReadDataStream:
    return ReadDataStream(BytesIO(content))
