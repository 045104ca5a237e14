"""The messages of a chunk, and those outside chunks, in the order of log time: 34 bytes of memory a message."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex
from numpy.typing import ArrayLike, NDArray

from recordings.containers.container import LostMessage, RawMessage
from recordings.mcap.index import MESSAGE, PARSE_ERRORS, RECORD, lost_chunk

MAX_OPEN_BYTES = 1 << 28  # of unpacked chunks that overlap in time; those used longest ago are unpacked again when due


class OpenChunks:
    """The unpacked chunks of one reader, at most `MAX_OPEN_BYTES` or a single one."""

    def __init__(self, unpack: Callable[[ChunkIndex], bytes | memoryview]) -> None:
        self._unpack = unpack
        self._open: dict[int, bytes | memoryview] = {}  # by offset in the file, the one used last at the end

    def records(self, chunk: ChunkIndex) -> bytes | memoryview:
        """The records of a chunk."""
        offset = chunk.chunk_start_offset
        found = self._open.pop(offset, None)
        if found is None:
            self._make_room(chunk.uncompressed_size)
            found = self._unpack(chunk)
            self._make_room(len(found))
        self._open[offset] = found
        return found

    def close(self, chunk: ChunkIndex) -> None:
        """Forget a chunk."""
        self._open.pop(chunk.chunk_start_offset, None)

    def _make_room(self, size: int) -> None:
        total = size + sum(map(len, self._open.values()))
        while self._open and total > MAX_OPEN_BYTES:
            total -= len(self._open.pop(next(iter(self._open))))


class ChunkMessages(Sequence[RawMessage | LostMessage]):
    """The messages of a chunk, in file order. Raises ValueError for a record that is cut."""

    def __init__(self, chunk: ChunkIndex, opened: OpenChunks) -> None:
        self._records, self._close = partial(opened.records, chunk), partial(opened.close, chunk)
        self._offset = chunk.chunk_start_offset
        self._channels, self._times, self._starts, self._ends = array("H"), array("Q"), array("Q"), array("Q")
        records = memoryview(self._records())
        position, size, message = 0, len(records), int(Opcode.MESSAGE)
        while position < size:
            if position + RECORD.size > size:
                raise ValueError("a record is longer than its section")
            opcode, length = RECORD.unpack_from(records, position)
            start, position = position + RECORD.size, position + RECORD.size + length
            if position > size:
                raise ValueError("a record is longer than its section")
            if opcode == message:
                if length < MESSAGE.size:
                    raise ValueError("a message is cut short")
                channel, _, log_time, _ = MESSAGE.unpack_from(records, start)
                self._channels.append(channel)
                self._times.append(log_time)
                self._starts.append(start + MESSAGE.size)
                self._ends.append(position)

    def __len__(self) -> int:
        return len(self._times)

    def __getitem__(self, number: int) -> RawMessage | LostMessage:  # type: ignore[override]  # no slices
        channel, log_time = self._channels[number], self._times[number]
        try:
            records = self._records()
            data = memoryview(records)[self._starts[number] : self._ends[number]]
            if 2 * len(data) < len(records):  # a message that waits keeps no chunk in memory
                data = memoryview(bytes(data))
        except PARSE_ERRORS as error:  # it was unpacked before: the file has changed, or the memory is full
            return LostMessage(channel, log_time, lost_chunk(self._offset, error))
        return RawMessage(channel, log_time, data)

    def in_order(self, channels: set[int], places: range) -> Iterator[Ordered]:
        """The messages of some channels in log-time order, not read yet. places: those wanted of the chunk."""
        own = np.frombuffer(self._channels, np.uint16) if len(self) else np.zeros(0, np.uint16)
        for number in in_log_time_order(own, self._times, channels, places):
            yield self._times[number], number, self
        self._close()


# Log time in ns; place in the chunk; the item, or the chunk that has it at that place, so that nothing waits unpacked
Ordered = tuple[int, int, RawMessage | LostMessage | ChunkMessages]


def in_log_time_order(
    channels: NDArray[np.integer[Any]], times: ArrayLike, wanted: set[int], places: range
) -> Iterator[int]:
    """The places of the messages of some channels, in the order of their log times, ns."""
    numbers = np.flatnonzero(np.isin(channels, sorted(wanted)))
    numbers = numbers[(numbers >= places.start) & (numbers < places.stop)]
    order = np.argsort(np.asarray(times, np.uint64)[numbers], kind="stable")
    return map(int, numbers[order])
