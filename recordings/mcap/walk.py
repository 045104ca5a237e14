"""Indexes an MCAP file that carries no index, or a broken one, by walking through all of it once.

Each record is looked at only as far as it matters, so memory holds one chunk. The walk goes on behind a broken chunk,
rescues what a cut one still holds, and where nothing is a record any more goes on at the next chunk that looks whole;
each loss is noted.
"""

from __future__ import annotations

import struct
from contextlib import suppress
from typing import BinaryIO

from isal.isal_zlib import crc32
from mcap.opcode import Opcode
from mcap.records import ChunkIndex

from flow.contracts import counted
from recordings.errors import said
from recordings.mcap.chunk import HEAD, LARGEST, is_chunk, next_chunk, start_time, unpacked, unpacked_start
from recordings.mcap.index import (
    BROKEN,
    MAGIC,
    MESSAGE,
    RECORD,
    Index,
    Loose,
    profile_of,
    raw,
    read,
    records,
    summary,
)

_PRIVATE = 0x80  # from here on, opcodes are free for private use
_LONGEST = {Opcode.CHUNK: LARGEST, Opcode.MESSAGE: MESSAGE.size, Opcode.ATTACHMENT: 0}  # bytes that are looked at
_DEFINITION = 1 << 24  # bytes; of any other record
_RESCUE = 1 << 26  # bytes; of what may have been a chunk
_BLOCK = 1 << 20


def walk(file: BinaryIO, size: int) -> Index:
    """The index of a file, from its data section."""
    own = summary(file, size) or Index()  # what it defines may be lost in the data section
    index = Index(own.schemas, own.channels, expected=own.expected, walked=True)
    position, before = len(MAGIC), 0
    checksum: int | None = crc32(MAGIC)  # None: bytes were passed over
    while True:
        head = read(file, position, HEAD)
        opcode, length = RECORD.unpack_from(head) if len(head) >= RECORD.size else (0, 0)
        is_record = opcode != Opcode.CHUNK or is_chunk(head)
        if opcode == 0 or length > size - position - RECORD.size or not is_record:
            found = next_chunk(file, position + 1, size)
            _note_damage(index, file, position, found, size)
            if found is None:
                return index
            position, before, checksum = found, opcode or int(Opcode.CHUNK), None
            continue
        content = read(file, position + RECORD.size, min(length, _LONGEST.get(opcode, _DEFINITION)))
        if opcode == Opcode.DATA_END and 4 <= length < MESSAGE.size:  # a longer one was once something else
            if checksum is not None and struct.unpack_from("<I", content)[0] not in (0, checksum):
                index.lose("the CRC of the data section does not match: messages in it were changed, not known which")
            _note_rest(index, file, position, size)
            return index
        try:
            _note(index, opcode, content, length, position, before)
        except BROKEN as error:
            index.lose(f"the record at byte {position} is broken ({said(error)})")
        if checksum is not None:
            checksum = crc32(content, crc32(head[: RECORD.size], checksum))
            checksum = _checksum(file, position + RECORD.size + len(content), length - len(content), checksum)
        position, before = position + RECORD.size + length, opcode


def _checksum(file: BinaryIO, position: int, length: int, checksum: int) -> int:
    """The CRC, continued over so many bytes from `position`."""
    for start in range(0, length, _BLOCK):
        checksum = crc32(read(file, position + start, min(_BLOCK, length - start)), checksum)
    return checksum


def _note(index: Index, opcode: int, content: bytes, length: int, position: int, before: int) -> None:
    """Take note of one record of the data section. content: its start; before: the opcode of the one before it.

    A record that cannot be where it is was something else before it was damaged, perhaps messages: that raises.
    """
    if opcode == Opcode.CHUNK:
        _note_chunk(index, content, position)
    elif opcode == Opcode.MESSAGE:
        channel, _, log_time, _ = MESSAGE.unpack_from(content)
        index.loose.append(Loose(channel, log_time, position + RECORD.size + MESSAGE.size, length - MESSAGE.size))
        index.seen(channel, log_time)
    elif opcode == Opcode.HEADER and before == 0:
        index.profile = profile_of(content)
    elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
        index.define(opcode, content)
    elif opcode == Opcode.MESSAGE_INDEX:
        (listed,) = struct.unpack_from("<I", content, 2)
        if before not in (Opcode.CHUNK, Opcode.MESSAGE_INDEX) or listed % 16 or listed > length - 6:
            raise ValueError("a message index without its chunk")
    elif opcode not in (Opcode.ATTACHMENT, Opcode.METADATA) and opcode < _PRIVATE:
        raise ValueError(f"a record of kind {opcode} has no place there")


def _note_chunk(index: Index, content: bytes, position: int) -> None:
    try:
        inside = list(records(unpacked(content)))
    except BROKEN as error:
        reason = f"the chunk at byte {position} is broken and its messages are lost ({said(error)})"
        index.lose(reason, start_time(content))
        return
    offsets, times, before = {}, [], index.clocks.copy()
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
        index.before[position] = before


def _note_rest(index: Index, file: BinaryIO, position: int, size: int) -> None:
    """Note what follows the log whose data section ends at `position`, as where files were put one behind another."""
    for start in range(position, size, _BLOCK):
        place = read(file, start, _BLOCK + len(MAGIC) - 1).find(MAGIC)
        end = start + place + len(MAGIC)
        if place >= 0:
            if end < size:
                unread = f"the log ends at byte {end}, and {size - end} bytes behind that are not read"
                index.lose(f"{unread}; give each log by itself")
            return


def _note_damage(index: Index, file: BinaryIO, position: int, found: int | None, size: int) -> None:
    """Note that no record is at `position`; rescue what there still is if it was a chunk.

    found: where reading goes on, None where it does not.
    """
    end = size if found is None else found
    is_cut = is_chunk(read(file, position, HEAD))
    record = read(file, position, min(end - position, LARGEST if is_cut else _RESCUE))
    if record[:1] == bytes([Opcode.CHUNK]):
        with suppress(*BROKEN):  # nothing more is to be had then
            for opcode, content in records(unpacked_start(record[RECORD.size :]), whole=False):
                if opcode == Opcode.MESSAGE:
                    message = raw(content)
                    index.rescued.append((message, index.seen(message.channel, message.log_time)))
                else:
                    index.define(opcode, content)
    if found is None:
        held = counted(sum(map(len, index.times.values())), "message")
        index.lose(f"the log is cut or damaged at byte {position} of {size}; before that it holds {held}")
    else:
        index.lose(f"the log is damaged at byte {position}: what is between there and byte {found} may be lost")
