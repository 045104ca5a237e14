"""The index of a ROS 1 bag: where each message is, and its log time.

It is read from the bag's index records, 24 bytes of memory a message. A stopped recorder leaves no list of the chunks.
Then the file is walked through, and every chunk is unpacked once to find its messages.
"""

from __future__ import annotations

from array import array
from collections import defaultdict
from collections.abc import Callable
from functools import cached_property
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rosbags.rosbag1 import Reader, ReaderError
from rosbags.rosbag1.reader import Header, RecordType, read_bytes, read_uint32

from flow.contracts import counted
from recordings.errors import sentence_of
from recordings.mcap.chunk import MAX_CHUNK_BYTES

_LISTED = np.dtype([("seconds", "<u4"), ("rest", "<u4"), ("offset", "<u4")])  # a message in an index record
_ENTRY = np.dtype([("offset", "<u4"), ("connection", "<u4"), ("time", "<i8")])
_MAX_CONNECTIONS = 10_000
_FIRST_RECORD = 13  # after the line with the version


class BagIndex(Reader):
    """A bag whose index is known after `open` or `walk`, with the chunks and connections of rosbags' reader."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._entries = defaultdict[int, list[NDArray[Any]]](list)  # by the place of the chunk
        self._count = 0
        self._known = set[int]()  # connections that a walk has found

    def read_index_data(self, pos: int, indexes: dict[int, list[Any]]) -> None:
        """Read the index record of a connection in a chunk."""
        assert self.bio
        header = Header.read(self.bio, RecordType.IDXDATA)
        connection, count, size = header.get_uint32("conn"), header.get_uint32("count"), read_uint32(self.bio)
        if header.get_uint32("ver") != 1 or size != _LISTED.itemsize * count or size > MAX_CHUNK_BYTES:
            raise ReaderError("an index record is damaged")
        listed = np.frombuffer(read_bytes(self.bio, size), _LISTED)
        times = listed["seconds"].astype(np.int64) * 1_000_000_000 + listed["rest"]
        self._add(pos, listed["offset"], connection, times)

    def walk(self, unpacked: Callable[[int], bytes | str]) -> list[str]:
        """Read connections and messages from the chunks of a bag without index records; returns what is lost.

        unpacked: the place of a chunk -> its records, or why it is broken.
        """
        self.bio, size, position, lost = self.path.open("rb"), self.path.stat().st_size, _FIRST_RECORD, list[str]()
        while position < size:
            try:
                self.bio.seek(position)
                operation = Header.read(self.bio).get_uint8("op")
                after = self.bio.tell() + 4 + read_uint32(self.bio)
                if not RecordType.BAGHEADER <= operation <= RecordType.CONNECTION or after > size:
                    raise ReaderError("no whole record is there")
                if operation == RecordType.CHUNK:
                    self.bio.seek(position)
                    chunk = self.read_chunk()
                    if not chunk.datasize:  # a stopped recorder did not state the size of its last chunk
                        chunk, after = chunk._replace(datasize=size - chunk.datapos), size
                    self.chunks[position] = chunk
            except Exception as error:  # foreign bytes may fail the reader in any way
                cut = f"is truncated or damaged at byte {position} of {size} ({sentence_of(error).rstrip('.')})"
                return [*lost, f"the bag {cut}; intact before it: {counted(len(self), 'message')}"]
            if operation == RecordType.CHUNK and (why := self._walk_chunk(position, unpacked(position))):
                lost.append(why)
            position = after
        return lost

    def _walk_chunk(self, position: int, records: bytes | str) -> str:
        """Add the messages of a chunk; returns why some are lost, or an empty string."""
        if isinstance(records, str):
            return records
        offsets, connections, times, why = array("I"), array("I"), array("q"), ""
        stream, offset = BytesIO(records), 0
        try:
            while (offset := stream.tell()) < len(records):
                header = Header.read(stream)
                number = header.get_uint32("conn")
                if header.get_uint8("op") == RecordType.MSGDATA:
                    times.append(header.get_time("time"))
                    offsets.append(offset)
                    connections.append(number)
                elif number not in self._known:
                    self._add_connection(stream, offset, number)
                    continue
                stream.seek(read_uint32(stream), 1)
        except Exception as error:  # foreign bytes may fail the reader in any way
            why = f"the chunk at byte {position} is broken at its byte {offset} ({sentence_of(error).rstrip('.')})"
        self._add(position, offsets, connections, times)
        return why

    def _add_connection(self, stream: BytesIO, offset: int, number: int) -> None:
        """Read the connection at an offset in a chunk, so that the stream is after it."""
        if len(self._known) == _MAX_CONNECTIONS:
            raise ReaderError(f"the bag has over {_MAX_CONNECTIONS} connections")
        stream.seek(offset)
        self.connections.append(Reader.read_connection(cast(Any, SimpleNamespace(bio=stream))))
        self._known.add(number)

    def _add(self, chunk: int, offsets: ArrayLike, connections: ArrayLike, times: ArrayLike) -> None:
        entries = np.empty(np.shape(offsets), _ENTRY)
        entries["offset"], entries["connection"], entries["time"] = offsets, connections, times
        self._entries[chunk].append(entries)
        self._count += len(entries)

    def __len__(self) -> int:
        return self._count

    @cached_property
    def entries(self) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[Any]]:
        """Of every message of a known connection, in file order: the number of its chunk in `places`; that of its
        connection; its offset in the chunk, and its log time, ns.
        """
        known = np.array([connection.id for connection in self.connections] or [1 << 32], np.int64)
        order = np.argsort(known, kind="stable").astype(np.int32)
        chunks, numbers, ordered = [np.empty(0, np.int32)], [np.empty(0, np.int32)], [np.empty(0, _ENTRY)]
        for chunk, place in enumerate(self.places):
            found = np.concatenate(self._entries.pop(place))
            found = found[np.argsort(found["offset"], kind="stable")]
            number = order[np.searchsorted(known[order], found["connection"], side="right") - 1]
            is_known = known[number] == found["connection"]
            ordered.append(found[is_known])
            numbers.append(number[is_known])
            chunks.append(np.full(len(ordered[-1]), chunk, np.int32))
        return np.concatenate(chunks), np.concatenate(numbers), np.concatenate(ordered)

    @cached_property
    def places(self) -> list[int]:
        """The places of the chunks with messages, in the file, ascending."""
        return sorted(self._entries)
