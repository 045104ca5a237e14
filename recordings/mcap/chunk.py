"""Decompresses the chunks of an MCAP file, and finds chunks by their byte pattern where the file is damaged.

A chunk states its uncompressed size. No more than that is ever decompressed, so a small damaged chunk cannot fill the
memory.
"""

from __future__ import annotations

import re
import struct
from array import array
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame
import numpy as np
import zstandard
from isal.isal_zlib import crc32
from mcap.opcode import Opcode
from numpy.typing import NDArray

from recordings.errors import LogError
from recordings.mcap.index import MESSAGE, RECORD, read_at

MAX_CHUNK_BYTES = 1 << 28  # of a chunk or message, unpacked; recorders make chunks of a few MB
MAX_RATIO = 200  # of unpacked to packed bytes; more is a hostile file
_FREE_BYTES, _FREE_FILE_BYTES = 1 << 26, 1 << 30  # to which any chunk, and any file, may unpack
_FREE_PARTS_BYTES = 1 << 31  # likewise; some parts are unpacked several times
_MAX_PARTS_RATIO = 50  # of all parts together, beyond that
CHUNK_HEAD_BYTES = 128  # of a chunk record; they contain its length

Buffer = bytes | memoryview

_CHUNK = struct.Struct("<QQQII")  # start time, end time, size, CRC, length of the compression's name
_MAX_PADDING_BYTES = 64  # that may follow a chunk's stated content
_BLOCK_BYTES = 1 << 20
_CHUNK_PATTERN = re.compile(rb"\x06(?=.{5}\0{3}.{28}(?:\x04\0{3}zstd|\x03\0{3}lz4|\0{4}))", re.DOTALL)


class Unpacking:
    """Unpacks the parts of a file, one at a time, as long as all together have the size of a recording's."""

    def __init__(self) -> None:
        self._left = _FREE_PARTS_BYTES

    def of(self, packed: Buffer, unpack: Callable[[Buffer, int], Buffer], size: int) -> Buffer:
        """The first `size` bytes by `unpack`. Raises LogError where there are too many already."""
        if self._left < 0:
            raise LogError(f"the log's parts unpack to over {_MAX_PARTS_RATIO} times their size, unlike any recording")
        found = unpack(packed, size)
        self._left += _MAX_PARTS_RATIO * len(packed) - len(found)
        return found


def max_unpacked(packed: int) -> int:
    """The largest size, bytes, to which so many bytes may be unpacked."""
    return min(MAX_CHUNK_BYTES, max(_FREE_BYTES, MAX_RATIO * packed))


def check_size(path: Path, size: int, total: int) -> None:
    """Raise LogError for a file of `size` bytes whose chunks unpack to more than those of a recording could."""
    if total > max(_FREE_FILE_BYTES, MAX_RATIO * size):
        raise LogError(f"{path} unpacks to {total} bytes, {total // size} times its size, unlike any recording")


def is_chunk(head: bytes) -> bool:
    """Whether `head` (`CHUNK_HEAD_BYTES` bytes) begins a chunk record whose length matches that of its parts."""
    if len(head) < RECORD.size + _CHUNK.size or head[0] != Opcode.CHUNK:
        return False
    length = RECORD.unpack_from(head)[1]
    name_length = _CHUNK.unpack_from(head, RECORD.size)[-1]
    stated_at = RECORD.size + _CHUNK.size + name_length
    if stated_at + 8 > len(head):
        return False
    (packed,) = struct.unpack_from("<Q", head, stated_at)
    return bool(0 <= length - (_CHUNK.size + name_length + 8 + packed) <= _MAX_PADDING_BYTES)


def find_chunk(file: BinaryIO, position: int, size: int) -> int | None:
    """The offset of the next complete chunk at or after `position`; None if there is none."""
    while position < size:
        block = read_at(file, position, _BLOCK_BYTES + CHUNK_HEAD_BYTES)
        for match in _CHUNK_PATTERN.finditer(block):
            at = match.start()
            if is_chunk(block[at : at + CHUNK_HEAD_BYTES]):
                end = position + at + RECORD.size + RECORD.unpack_from(block, at)[1]
                if end <= size:
                    return position + at
        position += _BLOCK_BYTES
    return None


def chunk_start_time(content: Buffer) -> int:
    """The log time of a chunk's first message, ns, as its record states it."""
    return int(_CHUNK.unpack_from(content)[0])


def unpack_chunk(content: Buffer) -> Buffer:
    """The decompressed records of a chunk. Raises ValueError where the size or the CRC does not match."""
    _, _, size, checksum, _ = _CHUNK.unpack_from(content)
    compression, packed, length = _split_chunk(content)
    if len(packed) != length:
        raise ValueError(f"only {len(packed)} of {length} bytes are present")
    data = _decompress(compression, packed, size)
    if len(data) != size:
        more = "more than" if len(data) > size else f"{len(data)} bytes, not"
        raise ValueError(f"it unpacks to {more} {size}")
    if checksum and crc32(data) != checksum:
        raise ValueError("its CRC does not match")
    return data


def chunk_heads(file: BinaryIO, position: int, offsets: Sequence[int], size: int) -> Iterator[bytes]:
    """At most `size` first bytes of the records at ascending offsets of a chunk, without checking its CRC.

    Of a chunk that is not compressed, only these bytes are read. position: of the chunk record's content.
    """
    start = read_at(file, position, CHUNK_HEAD_BYTES)
    name_end = _CHUNK.size + _CHUNK.unpack_from(start)[-1]
    compression, content = str(start[_CHUNK.size : name_end], "utf-8"), position + name_end + 8
    if not compression:
        yield from (read_at(file, content + offset, size) for offset in offsets)
    elif compression == "zstd":
        file.seek(content)
        stream, at = zstandard.ZstdDecompressor().stream_reader(file, closefd=False), 0
        for offset, following in pairwise([*offsets, 1 << 62]):
            while at < offset and (skipped := len(stream.read(min(offset - at, _BLOCK_BYTES)))):
                at += skipped
            found = stream.read(min(size, following - offset))
            yield found
            at += len(found)
    else:
        raise ValueError(f"the start of a chunk in '{compression}' cannot be read alone")


class ChunkTable:
    """Channel, log time and place of each message in records. Raises ValueError for a cut record, if not `is_cut`.

    stated: channels and log times by the message index; a damaged one may have the messages in another order.
    """

    def __init__(self, records: Buffer, is_cut: bool = False, stated: NDArray[Any] | None = None) -> None:
        self.records = memoryview(records)
        self.channels, self.times, self.starts, self.ends = array("H"), array("Q"), array("Q"), array("Q")
        position, size, message = 0, len(self.records), int(Opcode.MESSAGE)
        while position < size:
            start = position + RECORD.size
            opcode, length = RECORD.unpack_from(self.records, position) if start <= size else (0, size)
            position = start + length
            if position > size:
                if is_cut:
                    break
                raise ValueError("a record is longer than its section")
            if opcode == message:
                if length < MESSAGE.size:
                    raise ValueError("a message is cut short")
                channel, _, log_time, _ = MESSAGE.unpack_from(self.records, start)
                self.channels.append(channel)
                self.times.append(log_time)
                self.starts.append(start + MESSAGE.size)
                self.ends.append(position)
        self._order: Sequence[int] = range(len(self.times))
        found = np.array([self.channels, self.times], np.uint64)
        if stated is not None and not np.array_equal(found, stated):
            own, other = np.lexsort(found), np.lexsort(stated)
            if np.array_equal(found[:, own], stated[:, other]):
                self._order = own[np.argsort(other)].tolist()
            elif not np.array_equal(found[0], stated[0]):
                raise ValueError("its message index has other messages")

    def __len__(self) -> int:
        """The number of bytes."""
        return len(self.records)

    def message(self, number: int) -> tuple[int, memoryview]:
        """Log time, ns, and bytes of a message; of a short one a copy, so that it keeps no chunk in memory."""
        place = self._order[number]
        data = self.records[self.starts[place] : self.ends[place]]
        return self.times[place], data if 2 * len(data) >= len(self.records) else memoryview(bytes(data))


def unpack_cut_chunk(content: Buffer) -> Buffer:
    """The part of a cut chunk that can still be decompressed. Its CRC cannot be checked."""
    compression, packed, _ = _split_chunk(content)
    return _decompress(compression, packed, _CHUNK.unpack_from(content)[2])


def _decompress(compression: str, packed: memoryview, size: int) -> Buffer:
    """At most size + 1 bytes of the decompressed content."""
    limit = max_unpacked(len(packed))
    if size > limit:
        raise ValueError(f"it states an uncompressed size of {size} bytes; the limit is {limit}")
    if not compression:
        return packed[: size + 1]
    if not packed:
        return b""
    if compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(packed) as stream:
            return bytes(stream.read(size + 1))
    if compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, size + 1))
    raise ValueError(f"unknown compression '{compression}' (supported: zstd, lz4, none)")


def _split_chunk(content: Buffer) -> tuple[str, memoryview, int]:
    """The compression's name, the compressed bytes, and their stated number."""
    name_end = _CHUNK.size + _CHUNK.unpack_from(content)[-1]
    (length,) = struct.unpack_from("<Q", content, name_end)
    view = memoryview(content)
    return str(view[_CHUNK.size : name_end], "utf-8"), view[name_end + 8 : name_end + 8 + length], length
