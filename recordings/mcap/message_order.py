"""The messages of a chunk, and those outside chunks, in the order of log time: 34 bytes of memory a message."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex
from numpy.typing import NDArray

from recordings.containers.container import LostMessage, RawMessage
from recordings.mcap.chunk import MAX_STORED_BYTES
from recordings.mcap.index import MESSAGE, PARSE_ERRORS, RECORD, lost_chunk

MAX_OPEN_BYTES = 1 << 28  # of unpacked chunks that overlap in time; those used longest ago are unpacked again when due


class OpenChunks:
    """The unpacked chunks of one reader, at most a share of `MAX_OPEN_BYTES` or a single one."""

    def __init__(self, unpack: Callable[[ChunkIndex], bytes | memoryview], share: float = 1.0) -> None:
        self._unpack, self._max_bytes = unpack, share * MAX_OPEN_BYTES
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
        while self._open and total > self._max_bytes:
            total -= len(self._open.pop(next(iter(self._open))))


class ChunkTable:
    """Channel, log time and place of each message in the records of a chunk. Raises ValueError for a cut record."""

    def __init__(self, records: bytes | memoryview) -> None:
        self.channels, self.times, self.starts, self.ends = array("H"), array("Q"), array("Q"), array("Q")
        view = memoryview(records)
        position, size, message = 0, len(view), int(Opcode.MESSAGE)
        while position < size:
            if position + RECORD.size > size:
                raise ValueError("a record is longer than its section")
            opcode, length = RECORD.unpack_from(view, position)
            start, position = position + RECORD.size, position + RECORD.size + length
            if position > size:
                raise ValueError("a record is longer than its section")
            if opcode == message:
                if length < MESSAGE.size:
                    raise ValueError("a message is cut short")
                channel, _, log_time, _ = MESSAGE.unpack_from(view, start)
                self.channels.append(channel)
                self.times.append(log_time)
                self.starts.append(start + MESSAGE.size)
                self.ends.append(position)


class LastTable:
    """The table of the chunk read last, for a large one that is read many times."""

    def __init__(self) -> None:
        self._last: tuple[int, ChunkTable] | None = None

    def of(self, chunk: ChunkIndex, opened: OpenChunks) -> ChunkTable:
        """The table of a chunk."""
        last = self._last
        if last is None or last[0] != chunk.chunk_start_offset:
            last = self._last = chunk.chunk_start_offset, ChunkTable(opened.records(chunk))
        return last[1]


class ChunkMessages(Sequence[RawMessage | LostMessage]):
    """The messages of a chunk, in file order."""

    def __init__(self, chunk: ChunkIndex, opened: OpenChunks, table: ChunkTable) -> None:
        self._records, self._close = partial(opened.records, chunk), partial(opened.close, chunk)
        self._offset, self._table = chunk.chunk_start_offset, table

    def __len__(self) -> int:
        return len(self._table.times)

    def __getitem__(self, number: int) -> RawMessage | LostMessage:  # type: ignore[override]  # no slices
        channel, log_time = self._table.channels[number], self._table.times[number]
        if lost := too_long(channel, log_time, self._table.ends[number] - self._table.starts[number]):
            return lost
        try:
            records = self._records()
            data = memoryview(records)[self._table.starts[number] : self._table.ends[number]]
            if 2 * len(data) < len(records):  # a message that waits keeps no chunk in memory
                data = memoryview(bytes(data))
        except PARSE_ERRORS as error:  # it was unpacked before: the file has changed, or the memory is full
            return LostMessage(channel, log_time, lost_chunk(self._offset, error))
        return RawMessage(channel, log_time, data)

    def in_order(self, channels: set[int], places: range) -> Iterator[Ordered]:
        """The messages of some channels in log-time order, not read yet. places: those wanted of the chunk."""
        own = np.frombuffer(self._table.channels, np.uint16) if len(self) else np.zeros(0, np.uint16)
        times = np.asarray(self._table.times, np.uint64)
        for number in in_log_time_order(own, times.__getitem__, channels, places):
            yield self._table.times[number], number, self
        self._close()


def too_long(channel: int, log_time: int, length: int) -> LostMessage | None:
    """The loss of a message that is longer than any recorder writes."""
    if length <= MAX_STORED_BYTES:
        return None
    return LostMessage(channel, log_time, f"the message has {length} bytes; the limit is {MAX_STORED_BYTES}")


# Log time in ns; place in the chunk; the item, or the chunk that has it at that place, so that nothing waits unpacked
Ordered = tuple[int, int, RawMessage | LostMessage | ChunkMessages]


def in_log_time_order(
    channels: NDArray[np.integer[Any]],
    times_of: Callable[[NDArray[np.intp]], NDArray[np.uint64]],
    wanted: set[int],
    places: range,
) -> Iterator[int]:
    """The places of the messages of some channels, in the order of their log times, ns."""
    numbers = np.flatnonzero(np.isin(channels, sorted(wanted)))
    numbers = numbers[(numbers >= places.start) & (numbers < places.stop)]
    return map(int, numbers[np.argsort(times_of(numbers), kind="stable")])
