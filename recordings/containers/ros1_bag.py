"""Reads a ROS 1 bag (.bag, version 2.0). The connections are read by rosbags, the index and the chunks here.

A chunk is unpacked when its first message is due and dropped after its last one, so memory holds only chunks that
overlap in time. A broken chunk loses its own messages.
"""

from __future__ import annotations

import bz2
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import lz4.frame
from rosbags.rosbag1 import ReaderError
from rosbags.rosbag1.reader import Compression, Header, RecordType, decompressors, read_bytes, read_uint32

from flow.contracts import counted
from recordings.containers.bag_index import BagIndex
from recordings.containers.container import (
    Channel,
    Container,
    LostMessage,
    MessageSchema,
    OpenChunks,
    RawMessage,
)
from recordings.containers.timeline import Places, Timeline
from recordings.errors import LogError, sentence_of
from recordings.mcap.chunk import MAX_CHUNK_BYTES, Unpacking, max_unpacked


class Ros1Bag(Container):
    """A ROS 1 bag open for reading, also without an index. Raises LogError for a bag without readable messages."""

    profile = "ros1"

    def __init__(self, path: Path) -> None:
        self.path, self.size = path, path.stat().st_size
        self.lost: list[LostMessage] = []
        self._bag, self._unpacking = BagIndex(path), Unpacking()
        self.indexed, lost = True, list[str]()
        try:
            self._bag.open()
        except Exception as error:  # foreign bytes may fail the reader in any way
            self.indexed = False
            self._bag = BagIndex(path)
            lost = self._bag.walk(self._unpacked)
            if not len(self._bag):
                self.close()
                why = sentence_of(error).rstrip(".").removesuffix(", reindex before reading")
                raise LogError(f"{path} cannot be read ({why}); record it again, as no message is found") from error
        try:
            self.channels = {
                number: Channel(number, connection.topic, "ros1", _schema(connection))
                for number, connection in enumerate(self._bag.connections)
            }
            _, channels, entries = self._bag.entries
            self.timeline = Timeline(channels, entries["time"])
            if unknown := len(self._bag) - len(self.timeline):
                lost.append(f"{counted(unknown, 'message')} of an undefined connection cannot be read")
            self.start, self.end = self._ends()
            self.lost += [LostMessage(None, self.end, why) for why in lost]
        except BaseException:
            self.close()
            raise

    def read(self, places: Places) -> Iterator[RawMessage | LostMessage]:
        """The messages at some places of the timeline."""
        of_chunk, _, entries = self._bag.entries
        opened = OpenChunks(of_chunk[places], lambda number: self._unpacked(self._bag.places[number]))

        def content(place: int) -> memoryview | str:
            number = int(of_chunk[place])
            return _message_at(opened.of_next(number), self._bag.places[number], int(entries["offset"][place]))

        return self._read_each(places, content)

    def close(self) -> None:
        """Close the file."""
        if self._bag.bio is not None:
            self._bag.close()

    def _unpacked(self, position: int) -> bytes | str:
        """The records of a chunk, or why it is broken."""
        chunk = self._bag.chunks[position]
        try:
            assert self._bag.bio
            self._bag.bio.seek(chunk.datapos)
            if chunk.datasize > MAX_CHUNK_BYTES:
                raise ValueError(f"it has {chunk.datasize} bytes; the limit is {MAX_CHUNK_BYTES}")
            packed = read_bytes(self._bag.bio, chunk.datasize)
            limit, records = max_unpacked(len(packed)), packed
            if chunk.decompressor is decompressors[Compression.BZ2.value]:
                records = bytes(self._unpacking.of(packed, bz2.BZ2Decompressor().decompress, limit + 1))
            elif chunk.decompressor is decompressors[Compression.LZ4.value]:
                unpack = lz4.frame.LZ4FrameDecompressor().decompress
                records = bytes(self._unpacking.of(packed, unpack, limit + 1))
            if len(records) > limit:
                raise ValueError(f"it unpacks from {len(packed)} to more than {limit} bytes")
            return records
        except Exception as error:  # foreign bytes may fail a codec in any way
            return f"the chunk at byte {position} is broken and its messages are lost ({sentence_of(error)})"


def _schema(connection: object) -> MessageSchema:
    """The schema of a connection, named as ROS 1 does: sensor_msgs/Image."""
    name, definition = connection.msgtype, connection.msgdef  # type: ignore[attr-defined]
    return MessageSchema(name.replace("/msg/", "/"), "ros1msg", definition.data.encode())


def _message_at(chunk: bytes | str, position: int, offset: int) -> memoryview | str:
    """The bytes of the message at an offset of a chunk, or why it is lost."""
    if isinstance(chunk, str):
        return chunk
    records = BytesIO(chunk)
    records.seek(offset)
    try:
        header = Header.read(records)
        while header.get_uint8("op") == RecordType.CONNECTION:
            records.seek(read_uint32(records), 1)
            header = Header.read(records)
        if header.get_uint8("op") != RecordType.MSGDATA:
            raise ReaderError("the index points to no message")
        size, begin = read_uint32(records), records.tell()
        if begin + size > len(chunk):
            raise ReaderError(f"only {len(chunk) - begin} of {size} bytes are present")
    except Exception as error:  # foreign bytes may fail the reader in any way
        return f"the message at byte {offset} of the chunk at byte {position} is broken ({sentence_of(error)})"
    return memoryview(chunk)[begin : begin + size]
