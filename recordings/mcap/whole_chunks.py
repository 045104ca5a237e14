"""Reads the start of an unfinished log that is surely whole: chunks whose CRC and message indexes are right."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import BinaryIO

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, MessageIndex, Schema

from recordings.containers.container import RawMessage
from recordings.mcap.chunk import CHUNK_HEAD_BYTES, MAX_CHUNK_BYTES, is_chunk, unpack_chunk
from recordings.mcap.index import PARSE_ERRORS, RECORD, Index, iter_records, parse_message, read_at


@dataclass
class WholeChunk:
    """A chunk with its message indexes.

    index: its record for the summary; schemas, channels: those that it defines; listed: channel and log time, ns, of
    each message; end: offset in the file after its message indexes.
    """

    index: ChunkIndex
    schemas: dict[int, Schema]
    channels: dict[int, Channel]
    listed: list[tuple[int, int]]
    end: int

    def messages(self, file: BinaryIO) -> list[RawMessage]:
        """Its messages."""
        content = read_at(file, self.index.chunk_start_offset + RECORD.size, self.index.chunk_length - RECORD.size)
        records = iter_records(unpack_chunk(content))
        return [parse_message(record) for opcode, record in records if opcode == Opcode.MESSAGE]


def whole_chunks(file: BinaryIO, position: int) -> Iterator[WholeChunk]:
    """The chunks from an offset on, up to the first one that is not whole."""
    while (chunk := _chunk_at(file, position)) is not None:
        yield chunk
        position = chunk.end


def _chunk_at(file: BinaryIO, position: int) -> WholeChunk | None:
    head = read_at(file, position, CHUNK_HEAD_BYTES)
    if not is_chunk(head) or (length := RECORD.unpack_from(head)[1]) > MAX_CHUNK_BYTES:
        return None
    content = read_at(file, position + RECORD.size, length)
    try:
        return _with_indexes(file, position, content)
    except PARSE_ERRORS:
        return None


def _with_indexes(file: BinaryIO, position: int, content: bytes) -> WholeChunk | None:
    """The chunk of a record's content; None if the message indexes after it are not its own. Raises `PARSE_ERRORS`."""
    records, own, offset = unpack_chunk(content), Index(), 0
    indexes, listed = dict[int, MessageIndex](), list[tuple[int, int]]()
    for opcode, record in iter_records(records):
        if opcode == Opcode.MESSAGE:
            message = parse_message(record)
            index = indexes.setdefault(message.channel, MessageIndex(message.channel, []))
            index.records.append((message.log_time, offset))
            listed.append((message.channel, message.log_time))
        else:
            own.define(opcode, record)
        offset += RECORD.size + len(record)
    start, builder, places = position + RECORD.size + len(content), RecordBuilder(), dict[int, int]()
    for channel, index in indexes.items():
        places[channel] = start + builder.count
        index.write(builder)
    written: bytes = builder.end()  # type: ignore[no-untyped-call]
    if not indexes or read_at(file, start, len(written)) != written:
        return None
    chunk = Chunk.read(ReadDataStream(BytesIO(content)))
    entry = ChunkIndex(
        chunk_length=start - position, chunk_start_offset=position, compression=chunk.compression,
        compressed_size=len(chunk.data), message_end_time=chunk.message_end_time, message_index_length=len(written),
        message_index_offsets=places, message_start_time=chunk.message_start_time,
        uncompressed_size=chunk.uncompressed_size,
    )  # fmt: skip
    return WholeChunk(entry, own.schemas, own.channels, listed, start + len(written))
