"""Unpacks the chunks of an MCAP file, and finds chunks by their look where the records before them are damaged.

A chunk states how many bytes it unpacks to, and no more than that is ever unpacked: one that claims little and holds
much is broken, not a way to fill the memory.
"""

from __future__ import annotations

import re
import struct
from typing import BinaryIO

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from isal.isal_zlib import crc32
from mcap.opcode import Opcode

from recordings.mcap.index import RECORD, read

LARGEST = 1 << 32  # bytes; a larger chunk is not read
HEAD = 128  # bytes of a chunk record that tell how long it is

_CHUNK = struct.Struct("<QQQII")  # start time, end time, size, CRC, length of the compression's name
_PADDING = 64  # bytes that may follow what a chunk states
_BLOCK = 1 << 20
_LOOK = re.compile(rb"\x06(?=.{5}\0{3}.{28}(?:\x04\0{3}zstd|\x03\0{3}lz4|\0{4}))", re.DOTALL)


def is_chunk(head: bytes) -> bool:
    """Whether a record that begins with these bytes (`HEAD` of them) is a chunk as long as its parts say."""
    if len(head) < RECORD.size + _CHUNK.size or head[0] != Opcode.CHUNK:
        return False
    length = RECORD.unpack_from(head)[1]
    name_length = _CHUNK.unpack_from(head, RECORD.size)[-1]
    stated_at = RECORD.size + _CHUNK.size + name_length
    if stated_at + 8 > len(head):
        return False
    (packed,) = struct.unpack_from("<Q", head, stated_at)
    return bool(0 <= length - (_CHUNK.size + name_length + 8 + packed) <= _PADDING)


def next_chunk(file: BinaryIO, position: int, size: int) -> int | None:
    """Where the next chunk begins that looks whole, at or behind `position`; None where there is none."""
    while position < size:
        block = read(file, position, _BLOCK + HEAD)
        for match in _LOOK.finditer(block):
            at = match.start()
            if is_chunk(block[at : at + HEAD]):
                end = position + at + RECORD.size + RECORD.unpack_from(block, at)[1]
                if end <= size:
                    return position + at
        position += _BLOCK
    return None


def start_time(content: bytes) -> int:
    """The log time of a chunk's first message, ns, as its record states it."""
    return int(_CHUNK.unpack_from(content)[0])


def unpacked(content: bytes) -> bytes:
    """The records of a chunk record, decompressed, size and CRC checked. Raises where it is not what it states."""
    _, _, size, checksum, _ = _CHUNK.unpack_from(content)
    compression, packed, length = _packed(content)
    if len(packed) != length:
        raise ValueError(f"{len(packed)} of {length} bytes are there")
    data = _decompressed(compression, packed, size)
    if len(data) != size:
        more = "more than" if len(data) > size else f"{len(data)} bytes, not"
        raise ValueError(f"it unpacks to {more} {size}")
    if checksum and crc32(data) != checksum:
        raise ValueError("its CRC does not match")
    return data


def unpacked_start(content: bytes) -> bytes:
    """As much of a cut chunk as can still be decompressed; there is no CRC for a part."""
    compression, packed, _ = _packed(content)
    return _decompressed(compression, packed, _CHUNK.unpack_from(content)[2])


def _decompressed(compression: str, packed: memoryview, size: int) -> bytes:
    """What `packed` holds, but at most one byte more than `size`."""
    if size > LARGEST:
        raise ValueError(f"it says that it unpacks to {size} bytes, more than a chunk may ({LARGEST})")
    if not compression:
        return bytes(packed[: size + 1])
    if not packed:
        return b""
    if compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(packed) as stream:
            return bytes(stream.read(size + 1))
    if compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, size + 1))
    raise ValueError(f"compression '{compression}' is not known, only zstd, lz4 and none are")


def _packed(content: bytes) -> tuple[str, memoryview, int]:
    """Compression, the compressed bytes, and how many they should be."""
    name_end = _CHUNK.size + _CHUNK.unpack_from(content)[-1]
    (length,) = struct.unpack_from("<Q", content, name_end)
    view = memoryview(content)
    return str(view[_CHUNK.size : name_end], "utf-8"), view[name_end + 8 : name_end + 8 + length], length
