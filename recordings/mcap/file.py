"""Reads the raw messages of an MCAP file in log-time order, whatever state the file is in.

Chunks wait in a queue by their start time and are opened when their turn comes, so memory holds what overlaps and no
more. CRCs are always checked. What cannot be read comes as a `Lost` in its place in time, and reading goes on: a broken
chunk costs its own messages, a cut file what was cut.
"""

from __future__ import annotations

import struct
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from functools import cached_property
from heapq import heapify, heappop, heappush
from itertools import accumulate
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema
from numpy.typing import NDArray

from flow.contracts import counted
from recordings.errors import LogError, said
from recordings.mcap.chunk import LARGEST, unpacked
from recordings.mcap.index import (
    BROKEN,
    JITTER,
    LAST_TIME,
    MAGIC,
    RECORD,
    Clock,
    Loose,
    Lost,
    Raw,
    T,
    from_summary,
    in_order,
    raw,
    read,
    records,
)
from recordings.mcap.walk import walk
from recordings.ros2.cdr import decoder_for

CONVERT = "rosbags-convert --src IN.bag --dst OUT --dst-storage mcap"  # of a ROS 1 bag; mcap convert leaves it ROS 1


class McapFile:
    """An MCAP file open for reading; use as a context manager.

    start, end: log time of the first and the last message, ns; `index.walked` tells that the file had no index (or a
    broken one) and was read through. Raises LogError where there is nothing to read: no such file, not an MCAP file, no
    messages.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self._file = _opened(self.path)
        try:
            self.size = self.path.stat().st_size
            self.index = from_summary(self._file, self.size) or walk(self._file, self.size)
            for number in self.index.times.keys() - self.index.channels.keys():
                unknown = counted(len(self.index.times[number]), "message")
                self.index.lose(f"{unknown} of channel {number}, which the log does not define, cannot be read")
            self.start, self.end = self._time_range()
        except BaseException:
            self._file.close()
            raise

    def channel(self, number: int) -> Channel:
        """A channel by its number."""
        return self.index.channels[number]

    def schema(self, channel: Channel) -> Schema | None:
        """The schema of a channel's messages, None where it has none."""
        return self.index.schemas.get(channel.schema_id)

    def channels_of(self, topics: Iterable[str]) -> set[int]:
        """The channels that carry the topics; several may carry one."""
        wanted = set(topics)
        return {number for number, channel in self.index.channels.items() if channel.topic in wanted}

    def messages(
        self, channels: set[int], start: int | None = None, end: int | None = None, any_order: bool = False
    ) -> Iterator[Raw | Lost]:
        """The messages of `channels` with start <= log time < end, ns, in log-time order (ties: in file order).

        What is lost of them, or may be, comes in its place; where its log time is damaged, behind all others. Where the
        clock was set back, what follows is lost until a second after that time, unless messages may be in `any_order`;
        it was where one of `channels` fell back, as a log may be written topic by topic.
        """
        low, high = (0 if start is None else start), (1 << 64 if end is None else end)
        ordered = set[int]() if any_order else channels
        queue = self._queue(channels, ordered)
        found = dict.fromkeys(channels, 0)
        while queue and queue[0][0] < high:
            log_time, offset, _, item = heappop(queue)
            if isinstance(item, ChunkIndex):
                if item.message_end_time >= low:
                    for place, inside in enumerate(self._chunk_or_lost(item, ordered)):
                        heappush(queue, (inside.log_time, offset, place, inside))
            elif item.channel is None or item.channel in channels:
                if item.channel is not None:
                    found[item.channel] += 1
                if log_time > LAST_TIME:
                    damage = f"a message's log time is damaged ({log_time} ns), so the message is lost"
                    yield Lost(item.channel, self.end, item.reason if isinstance(item, Lost) else damage)
                elif log_time >= low:
                    yield self._loose_message(item) if isinstance(item, Loose) else item
        if start is None and end is None:
            yield from self._unaccounted(found)

    def times(self, channels: set[int]) -> NDArray[np.int64]:
        """The log times of channels' messages, ns, sorted; where the file is indexed, without reading the messages.

        Those that the clock showed once more after it was set back are left out.
        """
        found = defaultdict[int | None, list[int]](list)
        if self.index.walked:
            found.update((channel, self.index.times.get(channel, array("Q")).tolist()) for channel in channels)
        else:
            for chunk in self._chunks(channels):
                for item in self._contents(chunk):
                    found[item.channel].append(item.log_time)
        kept = [np.zeros(0, np.int64)]
        for channel in channels:
            times = np.array([time for time in found[channel] if time <= LAST_TIME], np.int64)
            if np.any(np.maximum.accumulate(times) - times > JITTER):
                clocks = accumulate(times.tolist(), Clock.then, initial=Clock())
                times = times[[not clock.back for clock in clocks][1:]]
            kept.append(times)
        return np.sort(np.concatenate(kept))

    def count(self, channels: set[int]) -> int:
        """How many messages of the channels the file holds, by its statistics or by the walk."""
        index = self.index
        if index.walked:
            return sum(len(index.times.get(channel, ())) for channel in channels)
        return sum(index.expected.get(channel, 0) for channel in channels)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> McapFile:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def _queue(self, channels: set[int], ordered: set[int]) -> list[tuple[int, int, int, Any]]:
        """What may be read, as a heap of (time, offset in the file, place in a chunk, thing)."""
        index = self.index
        queue: list[tuple[int, int, int, Any]] = []
        queue += [(lost.log_time, self.size, place, lost) for place, lost in enumerate(index.lost)]
        for place, (found, clock) in enumerate(index.rescued, -len(index.rescued)):
            queue.append((found.log_time, self.size, place, in_order(found, [clock] if ordered else ())))
        loose = [item for item in index.loose if item.channel in channels]
        for found_at, item in zip(loose, _in_order(loose, {}, ordered), strict=True):
            queue.append((item.log_time, found_at.offset, -1, item))
        queue += [(chunk.message_start_time, chunk.chunk_start_offset, -1, chunk) for chunk in self._chunks(channels)]
        heapify(queue)
        return queue

    def _chunks(self, channels: set[int]) -> list[ChunkIndex]:
        """The chunks that hold, or may hold, messages of the channels, in file order."""
        chunks = sorted(self.index.chunks, key=lambda chunk: chunk.chunk_start_offset)
        return [c for c in chunks if not c.message_index_offsets or channels & c.message_index_offsets.keys()]

    @cached_property
    def _before(self) -> dict[int, dict[int | None, Clock]]:
        """Offset of a chunk -> the clocks of the channels where it begins.

        Empty where each chunk begins when those before it have ended: then what they hold does not matter.
        """
        if self.index.walked:
            return self.index.before
        chunks = [chunk for chunk in self._chunks(set(self.index.channels)) if chunk.message_end_time]
        ends = accumulate((chunk.message_end_time for chunk in chunks), max)
        if all(end - chunk.message_start_time <= JITTER for end, chunk in zip(ends, chunks[1:], strict=False)):
            return {}
        before, clocks = dict[int, dict[int | None, Clock]](), defaultdict[int | None, Clock](Clock)
        for chunk in chunks:
            before[chunk.chunk_start_offset] = clocks.copy()
            for item in self._contents(chunk):
                clocks[item.channel] = clocks[item.channel].then(item.log_time)
        return before

    def _chunk_or_lost(self, chunk: ChunkIndex, ordered: Collection[int] = ()) -> list[Raw | Lost]:
        """The messages of a chunk, or one `Lost` for each that its message index knows of."""
        try:
            before = self._before.get(chunk.chunk_start_offset, {}) if ordered else {}
            return _in_order(self._chunk_messages(chunk), before, ordered)
        except BROKEN as error:
            reason = f"the chunk at byte {chunk.chunk_start_offset} is broken and its messages are lost ({said(error)})"
        channels = chunk.message_index_offsets
        known = self._message_index(chunk) or [(number, chunk.message_start_time) for number in channels]
        lost = [Lost(channel, log_time, reason) for channel, log_time in known]
        return [*lost] or [Lost(None, chunk.message_start_time, reason)]

    def _chunk_messages(self, chunk: ChunkIndex) -> list[Raw]:
        length = chunk.chunk_length - RECORD.size
        head = read(self._file, chunk.chunk_start_offset, RECORD.size)
        if len(head) < RECORD.size or RECORD.unpack(head) != (int(Opcode.CHUNK), length):
            raise ValueError("no chunk is where the index has one")
        content = read(self._file, chunk.chunk_start_offset + RECORD.size, min(length, LARGEST))
        inside = records(unpacked(content))
        return [raw(content) for opcode, content in inside if opcode == Opcode.MESSAGE]

    def _loose_message(self, loose: Loose) -> Raw:
        return Raw(loose.channel, loose.log_time, memoryview(read(self._file, loose.offset, loose.size)))

    def _contents(self, chunk: ChunkIndex) -> list[Raw | Lost]:
        """Channel and log time of a chunk's messages, from its message index where it has one; a channel's in order."""
        known = self._message_index(chunk)
        return [Raw(number, time, memoryview(b"")) for number, time in known] or self._chunk_or_lost(chunk)

    def _message_index(self, chunk: ChunkIndex) -> list[tuple[int, int]]:
        """(channel, log time) of each message, from the message index behind a chunk; empty where that lacks or
        is broken.

        Those of one channel are in file order.
        """
        found: list[tuple[int, int]] = []
        first = chunk.chunk_start_offset + chunk.chunk_length
        with suppress(*BROKEN):
            for opcode, content in records(read(self._file, first, min(chunk.message_index_length, LARGEST))):
                if opcode == Opcode.MESSAGE_INDEX:
                    channel, size = struct.unpack_from("<HI", content)
                    pairs = np.frombuffer(content, "<u8", size // 16 * 2, 6).reshape(-1, 2)
                    found.extend((channel, time) for time in pairs[pairs[:, 1].argsort(kind="stable"), 0].tolist())
            return found
        return []

    def _unaccounted(self, found: dict[int, int]) -> Iterator[Lost]:
        """Messages that the file's statistics count and that nothing else has told of."""
        if any(item.channel is None for item in self.index.lost):
            return
        for channel, count in sorted(found.items()):
            if (expected := self.index.expected.get(channel, count)) > count:
                why = f"the log's statistics count {counted(expected, 'message')}, the log itself {count}"
                yield Lost(channel, self.end, why)

    def _time_range(self) -> tuple[int, int]:
        """Log time of the first and the last message, ns."""
        index = self.index
        if not index.times and (index.walked or not any(index.expected.values())):
            damage = f" that can be read: {index.lost[0].reason}" if index.lost else "; record it again"
            raise LogError(f"{self.path} holds no messages{damage}")
        if index.walked:
            ends = [end for times in index.times.values() for end in (min(times), max(times))]
        else:
            filled = [chunk for chunk in index.chunks if chunk.message_end_time] or index.chunks
            ends = [end for chunk in filled for end in (chunk.message_start_time, chunk.message_end_time)]
        if max(ends) > LAST_TIME:
            ends = self.times(set(index.channels)).tolist()
        if not ends:
            raise LogError(f"{self.path} holds no messages whose log times are whole; record it again")
        return min(ends), max(ends)


def _in_order(messages: Iterable[T], before: Mapping[int | None, Clock], ordered: Collection[int]) -> list[T | Lost]:
    """The messages, those as `Lost` before which a clock of the channels `ordered` was set back; before: the clocks."""
    clocks, found = defaultdict[int | None, Clock](Clock, before), list[T | Lost]()
    back = {channel for channel in ordered if channel in clocks and clocks[channel].back}
    for message in messages:
        clock = clocks[message.channel] = clocks[message.channel].then(message.log_time)
        if message.channel in ordered:
            (back.add if clock.back else back.discard)(message.channel)
        found.append(in_order(message, [clocks[channel] for channel in back]) if back else message)
    return found


def iter_decoded(
    path: Path, topics: Iterable[str] | None = None, lost: Counter[str] | None = None
) -> Iterator[tuple[str, int, Any]]:
    """(topic, log time in ns, decoded message) of a log's ROS 2 CDR channels, in log-time order.

    topics: which (None: all that are in CDR). Without `lost`, raises LogError at the first thing that cannot be read;
    else counts there why messages were lost.
    """

    def lose(why: str) -> None:
        if lost is None:
            raise LogError(f"{path}: {why}")
        lost[why] += 1

    wanted = None if topics is None else set(topics)
    with McapFile(Path(path)) as log:
        decoders: dict[int, Callable[[bytes | memoryview], Any]] = {}
        for number, channel in log.index.channels.items():
            schema = log.schema(channel)
            if schema and channel.message_encoding == "cdr" and (wanted is None or channel.topic in wanted):
                decoders[number] = decoder_for(schema.name, schema.encoding, schema.data)
        for item in log.messages(set(decoders), any_order=True):
            if isinstance(item, Lost):
                lose(item.reason)
                continue
            topic = log.channel(item.channel).topic
            try:
                message = decoders[item.channel](item.data)
            except Exception as error:  # foreign bytes may fail a codec in any way
                lose(f"{topic} at {item.log_time} ns cannot be decoded ({said(error)})")
                continue
            yield topic, item.log_time, message


def _opened(path: Path) -> BinaryIO:
    """The file, open, if it begins like an MCAP file."""
    if path.is_dir():
        raise LogError(f"{path} is a folder; give the .mcap file in it")
    if path.exists() and not path.is_file():
        raise LogError(f"{path} is a pipe or a device, in which nothing can be looked up; give a .mcap file")
    try:
        file = path.open("rb")
    except OSError as error:
        raise LogError(f"cannot read {path}: {error.strerror or error}") from error
    start = file.read(16)
    if start.startswith(MAGIC):
        return file
    file.close()
    if not start:
        raise LogError(f"{path} is empty (0 bytes); record it again")
    if start.startswith(b"#ROSBAG"):
        raise LogError(f"{path} is a ROS 1 bag; convert it to OUT/OUT.mcap first: {CONVERT}")
    if start.startswith(b"SQLite format 3"):
        raise LogError(f"{path} is a rosbag2 SQLite bag; convert it to MCAP first: mcap convert IN.db3 OUT.mcap")
    raise LogError(f"{path} is not an MCAP log (it does not begin like one); give a .mcap file")
