"""The messages of a chunk, and those outside chunks, in the order of log time: 34 bytes of memory a message."""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import ArrayLike, NDArray

from recordings.containers.container import LostMessage, RawMessage
from recordings.mcap.index import MESSAGE, RECORD

Ordered = tuple[int, int, RawMessage | LostMessage]  # log time in ns, place in the chunk, item


class ChunkMessages(Sequence[RawMessage]):
    """The messages of an unpacked chunk, in file order. Raises ValueError for a record that is cut."""

    def __init__(self, records: bytes | memoryview) -> None:
        self._records = memoryview(records)
        self._channels, self._times, self._starts, self._ends = array("H"), array("Q"), array("Q"), array("Q")
        position, size, message = 0, len(self._records), int(Opcode.MESSAGE)
        while position < size:
            if position + RECORD.size > size:
                raise ValueError("a record is longer than its section")
            opcode, length = RECORD.unpack_from(self._records, position)
            start, position = position + RECORD.size, position + RECORD.size + length
            if position > size:
                raise ValueError("a record is longer than its section")
            if opcode == message:
                if length < MESSAGE.size:
                    raise ValueError("a message is cut short")
                channel, _, log_time, _ = MESSAGE.unpack_from(self._records, start)
                self._channels.append(channel)
                self._times.append(log_time)
                self._starts.append(start + MESSAGE.size)
                self._ends.append(position)

    def __len__(self) -> int:
        return len(self._times)

    def __getitem__(self, number: int) -> RawMessage:  # type: ignore[override]  # no slices
        data = self._records[self._starts[number] : self._ends[number]]
        return RawMessage(self._channels[number], self._times[number], data)

    def in_order(self, channels: set[int], places: range) -> Iterator[Ordered]:
        """The messages of some channels in log-time order. places: those wanted of the chunk."""
        own = np.frombuffer(self._channels, np.uint16) if len(self) else np.zeros(0, np.uint16)
        for number in in_log_time_order(own, self._times, channels, places):
            yield self._times[number], number, self[number]


def in_log_time_order(
    channels: NDArray[np.integer[Any]], times: ArrayLike, wanted: set[int], places: range
) -> Iterator[int]:
    """The places of the messages of some channels, in the order of their log times, ns."""
    numbers = np.flatnonzero(np.isin(channels, sorted(wanted)))
    numbers = numbers[(numbers >= places.start) & (numbers < places.stop)]
    order = np.argsort(np.asarray(times, np.uint64)[numbers], kind="stable")
    return map(int, numbers[order])
