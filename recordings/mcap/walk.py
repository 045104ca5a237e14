"""Indexes an MCAP file without a valid summary by walking through all of its records once.

Of each record only the needed part is read, so memory holds one chunk. The walk continues after a broken chunk and
rescues the messages that a cut chunk still contains. After other damage it continues at the next complete chunk. Each
loss is noted.
"""

from __future__ import annotations

import struct
from array import array
from typing import BinaryIO

from isal.isal_zlib import crc32
from mcap.opcode import Opcode

from flow.contracts import counted
from recordings.errors import sentence_of
from recordings.mcap.chunk import (
    CHUNK_HEAD_BYTES,
    MAX_CHUNK_BYTES,
    ChunkTable,
    chunk_start_time,
    find_chunk,
    is_chunk,
    unpack_chunk,
    unpack_cut_chunk,
)
from recordings.mcap.index import (
    MAGIC,
    MESSAGE,
    PARSE_ERRORS,
    RECORD,
    Index,
    iter_records,
    lost_chunk,
    profile_of,
    read_at,
    read_summary,
)

_MIN_PRIVATE_OPCODE = 0x80
_MAX_READ_BYTES = {Opcode.CHUNK: MAX_CHUNK_BYTES, Opcode.MESSAGE: MESSAGE.size, Opcode.ATTACHMENT: 0}  # of a record
_MAX_RECORD_BYTES = 1 << 24  # of any other record
_MAX_RESCUE_BYTES = 1 << 26  # of what may have been a chunk
_BLOCK_BYTES = 1 << 20


def walk(file: BinaryIO, size: int) -> Index:
    """Build the index of a file from its data section."""
    index, *_ = read_summary(file, size) or (Index(),)  # its definitions may be lost in the data section
    index.walked = True
    position, before = len(MAGIC), 0
    checksum: int | None = crc32(MAGIC)  # None: bytes were skipped
    while True:
        head = read_at(file, position, CHUNK_HEAD_BYTES)
        opcode, length = RECORD.unpack_from(head) if len(head) >= RECORD.size else (0, 0)
        if opcode == Opcode.MESSAGE and length < _BLOCK_BYTES // 2:
            block = read_at(file, position, _BLOCK_BYTES)
            if taken := _note_messages(index, block, position):
                checksum = None if checksum is None else crc32(block[:taken], checksum)
                position, before = position + taken, opcode
                continue
        if not _is_record(file, position, size, head):
            found = find_chunk(file, position + 1, size)
            _note_damage(index, file, position, found, size)
            if found is None:
                return index
            position, before, checksum = found, opcode or int(Opcode.CHUNK), None
            continue
        content = read_at(file, position + RECORD.size, min(length, _MAX_READ_BYTES.get(opcode, _MAX_RECORD_BYTES)))
        if opcode == Opcode.DATA_END and 4 <= length < MESSAGE.size:  # a longer one was another record
            if checksum is not None and struct.unpack_from("<I", content)[0] not in (0, checksum):
                index.note_damage("the CRC of the data section does not match: some of its messages were changed")
            _note_rest(index, file, position, size)
            return index
        try:
            _note(index, opcode, content, length, position, before)
        except PARSE_ERRORS as error:
            index.note_damage(f"the record at byte {position} is broken ({sentence_of(error)})")
        if checksum is not None:
            checksum = crc32(content, crc32(head[: RECORD.size], checksum))
            checksum = _checksum(file, position + RECORD.size + len(content), length - len(content), checksum)
        position, before = position + RECORD.size + length, opcode


def _is_record(file: BinaryIO, position: int, size: int, head: bytes) -> bool:
    """Whether a record is within the file, and a chunk or a message index begins like one.

    A message index that is longer than its list may be padded, or have a wrong length that hides the next chunk: then
    no record of a data section begins after it.
    """
    opcode, length = RECORD.unpack_from(head) if len(head) >= RECORD.size else (0, 0)
    after = position + RECORD.size + length
    if opcode == 0 or after > size:
        return False
    if (
        opcode == Opcode.MESSAGE_INDEX
        and length >= 6
        and struct.unpack_from("<I", head, RECORD.size + 2)[0] + 6 < length
    ):
        following, end = RECORD.unpack(read_at(file, after, RECORD.size)) if after + RECORD.size <= size else (0, 0)
        return bool(0 < following <= Opcode.DATA_END and end <= size - after - RECORD.size)
    return opcode != Opcode.CHUNK or is_chunk(head)


def _checksum(file: BinaryIO, position: int, length: int, checksum: int) -> int:
    """The CRC, continued over `length` bytes from `position`."""
    for start in range(0, length, _BLOCK_BYTES):
        checksum = crc32(read_at(file, position + start, min(_BLOCK_BYTES, length - start)), checksum)
    return checksum


def _note(index: Index, opcode: int, content: bytes, length: int, position: int, before: int) -> None:
    """Note one record of the data section. content: its start; before: the opcode of the record before it.

    Raises ValueError for a record in an impossible place: it is damaged, and may have contained messages.
    """
    if opcode == Opcode.CHUNK:
        _note_chunk(index, content, position)
    elif opcode == Opcode.MESSAGE:
        channel, _, log_time, _ = MESSAGE.unpack_from(content)
        whole = RECORD.size + length
        index.add(position, whole, whole, array("H", [channel]), array("Q", [log_time]), is_bare=True)
    elif opcode == Opcode.HEADER and before == 0:
        index.profile = profile_of(content)
    elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
        index.define(opcode, content)
    elif opcode == Opcode.MESSAGE_INDEX:
        (listed,) = struct.unpack_from("<I", content, 2)
        if before not in (Opcode.CHUNK, Opcode.MESSAGE_INDEX) or listed % 16 or listed > length - 6:
            raise ValueError("a message index without its chunk")
    elif opcode not in (Opcode.ATTACHMENT, Opcode.METADATA) and opcode < _MIN_PRIVATE_OPCODE:
        raise ValueError(f"a record of opcode {opcode} is not allowed there")


def _note_messages(index: Index, block: bytes, position: int) -> int:
    """Note the messages at the start of a block; returns the length of their records."""
    taken = 0
    for opcode, content in iter_records(block, is_cut=True):
        if opcode != Opcode.MESSAGE or len(content) < MESSAGE.size:
            break
        taken += RECORD.size + len(content)
    if taken:
        table = ChunkTable(block[:taken])
        index.add(position, taken, taken, table.channels, table.times, is_bare=True)
    return taken


def _note_chunk(index: Index, content: bytes, position: int, is_cut: bool = False) -> None:
    """Note the messages of a chunk."""
    try:
        records = unpack_cut_chunk(content) if is_cut else unpack_chunk(content)
        table = ChunkTable(records, is_cut)  # a whole chunk with a cut record is broken
        for opcode, record in iter_records(records, is_cut):
            index.define(opcode, record)
    except PARSE_ERRORS as error:
        if not is_cut:  # else nothing more can be rescued
            index.note_damage(lost_chunk(position, error), chunk_start_time(content))
        return
    if table.times:
        index.add(position, RECORD.size + len(content), len(records), table.channels, table.times, is_cut=is_cut)


def _note_rest(index: Index, file: BinaryIO, position: int, size: int) -> None:
    """Note the bytes after the end of the log, as when log files were concatenated."""
    for start in range(position, size, _BLOCK_BYTES):
        place = read_at(file, start, _BLOCK_BYTES + len(MAGIC) - 1).find(MAGIC)
        end = start + place + len(MAGIC)
        if place >= 0:
            if end < size:
                unread = f"the log ends at byte {end}, and the {size - end} bytes after it are not read"
                index.note_damage(f"{unread}; give each log as its own file")
            return


def _note_damage(index: Index, file: BinaryIO, position: int, found: int | None, size: int) -> None:
    """Note that there is no record at `position`, and rescue the messages of a damaged chunk.

    found: where the walk continues; None at the end of the file.
    """
    end = size if found is None else found
    is_cut = is_chunk(read_at(file, position, CHUNK_HEAD_BYTES))
    record = read_at(file, position, min(end - position, MAX_CHUNK_BYTES if is_cut else _MAX_RESCUE_BYTES))
    if record[:1] == bytes([Opcode.CHUNK]):
        _note_chunk(index, record[RECORD.size :], position, is_cut=True)
    if found is None:
        held = counted(len(index.message_times), "message")
        index.note_damage(f"the log is truncated or damaged at byte {position} of {size}; intact before it: {held}")
    else:
        index.note_damage(f"the log is damaged from byte {position} to byte {found}; messages there may be lost")
