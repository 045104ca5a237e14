"""Reads the messages of an MCAP file in log-time order, even if the file is damaged.

Chunks wait in a queue by their start time and are opened one after the other, so memory holds only those that overlap.
CRCs are always checked. A broken chunk loses its own messages and a cut file what was cut; a `LostMessage` stands for
them, and reading continues.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import cached_property
from heapq import heapify, heappop, heappush
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex
from numpy.typing import NDArray

from flow.contracts import counted
from recordings.containers.container import Channel, LostMessage, MessageSchema, RawMessage
from recordings.containers.recording import Recording
from recordings.containers.timeline import MAX_LOG_TIME, Timeline
from recordings.errors import LogError, sentence_of
from recordings.mcap.chunk import HEAD_BYTES, MAX_CHUNK_BYTES, check_size, chunk_heads, unpack_chunk
from recordings.mcap.index import (
    MESSAGE,
    PARSE_ERRORS,
    RECORD,
    index_from_summary,
    iter_records,
    lost_chunk,
    opened,
    read_at,
)
from recordings.mcap.message_order import ChunkMessages, LastTable, OpenChunks, Ordered, in_log_time_order, too_long
from recordings.mcap.walk import walk
from recordings.ros2.cdr import decoder_for, is_packed

Edges = tuple[int | None, int | None]  # log times, ns, from which and before which messages are read


class _Queued(NamedTuple):
    """What comes next of a chunk, of the messages outside chunks, or of the losses. following: what comes then."""

    log_time: int
    offset: int  # in the file; of messages outside chunks -1
    place: int
    item: RawMessage | LostMessage | ChunkIndex | ChunkMessages
    following: Iterator[Ordered] = iter(())


class McapFile:
    """An MCAP file open for reading; use it as a context manager.

    start, end: log time of the first and the last message, ns; channels: by number, each with its encoding and schema;
    size: bytes; index: where chunks and messages are. Raises LogError if the file does not exist, is not an MCAP file
    or contains no messages.

    >>> from tempfile import TemporaryDirectory
    >>> from recordings.mcap.writer import Ros2Writer
    >>> from recordings.ros2.to_msg import imu
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder, "log.mcap")
    ...     with Ros2Writer(path) as writer:
    ...         writer.write("/imu/data", imu(1_000, "imu_link", [0, 0, 0, 1]), stamp=1_000)
    ...     with McapFile(path) as file:
    ...         [message.log_time for message in file.messages(file.channels_of(["/imu/data"]))]
    [1000]
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self._file = opened(self.path)
        self._last_table, self._recent = LastTable(), OpenChunks(self._unpacked, share=1 / 16)
        try:
            self.size = self.path.stat().st_size
            self.index = index_from_summary(self._file, self.size) or walk(self._file, self.size)
            self.channels = {number: self._channel(number) for number in self.index.channels}
            for number in sorted(set(self.index.counted_channels) - self.channels.keys()):
                unknown = counted(self.index.counted_channels.count(number), "message")
                self.index.note_damage(f"{unknown} of channel {number} cannot be read: the log does not define it")
            check_size(self.index, self.path, self.size)
            self.start, self.end = self._time_range()
        except BaseException:
            self._file.close()
            raise

    def channels_of(self, topics: Iterable[str]) -> set[int]:
        """The channels of some topics; a topic may have several."""
        wanted = set(topics)
        return {number for number, channel in self.channels.items() if channel.topic in wanted}

    def messages(
        self, channels: set[int], start: int | None = None, end: int | None = None, places: range | None = None
    ) -> Iterator[RawMessage | LostMessage]:
        """Read the messages of `channels` with start <= log time < end, ns, in log-time order (ties: in file order).

        A `LostMessage` stands at the log time of lost messages; if that time itself is damaged, at the end. places: of
        the messages in the timeline; None: all.
        """
        low, high = (0 if start is None else start), (1 << 64 if end is None else end)
        queue = self._queue(channels, places)
        found, opened = dict.fromkeys(channels, 0), OpenChunks(self._recent.records)
        while queue and queue[0].log_time < high:
            first = heappop(queue)
            log_time, item, following = first.log_time, first.item, first.following
            if isinstance(item, ChunkMessages):
                item = item[first.place]
            if isinstance(item, ChunkIndex):
                is_due = item.message_end_time >= low
                following = self._in_order(item, channels, places, opened) if is_due else following
            elif item.channel is None or item.channel in channels:
                if item.channel is not None:
                    found[item.channel] += 1
                if log_time > MAX_LOG_TIME:
                    damage = f"the message is lost: its log time is damaged ({log_time} ns)"
                    yield LostMessage(item.channel, self.end, item.reason if isinstance(item, LostMessage) else damage)
                elif log_time >= low:
                    yield item
            if (after := next(following, None)) is not None:
                heappush(queue, _Queued(after[0], first.offset, after[1], after[2], following))
        if start is None and end is None and places is None:
            yield from self._unaccounted(found)

    def heads(self, channels: set[int]) -> Iterator[RawMessage | LostMessage]:
        """The first bytes of the messages of some channels, in file order, without checking CRCs.

        Chunks without a message index, and messages that are compressed one by one, are read as a whole.
        """
        for chunk in self._chunks(channels):
            try:
                yield from list(self._chunk_heads(chunk, channels))
            except PARSE_ERRORS:
                yield from (item for item in self._chunk_or_lost(chunk) if item.channel in channels)
        yield from (item for _, _, item in self._unchunked(channels, None, HEAD_BYTES) if isinstance(item, RawMessage))
        yield from (message for _, message in self.index.rescued if message.channel in channels)
        yield from self.index.lost

    def _chunk_heads(self, chunk: ChunkIndex, channels: set[int]) -> Iterator[RawMessage]:
        numbers, times, offsets = self._message_index(chunk)
        if not len(numbers):
            raise ValueError("the chunk has no message index")
        wanted = np.isin(numbers, sorted(channels))
        place, size = chunk.chunk_start_offset + RECORD.size, RECORD.size + MESSAGE.size + HEAD_BYTES
        records = chunk_heads(self._file, place, offsets[wanted].tolist(), size)
        for number, time, record in zip(numbers[wanted].tolist(), times[wanted].tolist(), records, strict=True):
            data = memoryview(record)[RECORD.size + MESSAGE.size :]
            if record[:1] != bytes([Opcode.MESSAGE]) or is_packed(data):
                raise ValueError("there is no message of known start at the offset in the index")
            length = RECORD.unpack_from(record)[1] - MESSAGE.size
            yield RawMessage(number, time, data[:length])

    @cached_property
    def timeline(self) -> Timeline:
        """Channel and log time of every message, in file order; an indexed file is not decompressed for them."""
        index = self.index
        if not index.walked:
            for chunk in self._chunks(set(self.channels)):
                first = len(index.counted_times)
                channels, times, _ = self._message_index(chunk)
                index.counted_channels.frombytes(channels.tobytes())
                index.counted_times.frombytes(times.tobytes())
                for item in () if len(times) else self._chunk_or_lost(chunk):
                    if item.channel is not None:
                        index.count_message(item.channel, item.log_time)
                index.places[chunk.chunk_start_offset] = range(first, len(index.counted_times))
        return Timeline.of(index.counted_channels, index.counted_times)

    def times(self, channels: set[int]) -> NDArray[np.int64]:
        """The sorted log times of some channels, ns."""
        return self.timeline.times_of(channels)

    def count(self, channels: set[int]) -> int:
        """The number of messages in some channels, from the file's statistics or the walk."""
        if self.index.walked:
            return self.timeline.count(channels)
        return sum(self.index.stated_counts.get(channel, 0) for channel in channels)

    @property
    def profile(self) -> str:
        """The profile in the file's header."""
        return self.index.profile

    @property
    def indexed(self) -> bool:
        """Whether the file has a valid summary; otherwise it was read through."""
        return not self.index.walked

    @property
    def lost(self) -> list[LostMessage]:
        """The damage found so far."""
        return self.index.lost

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> McapFile:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def _channel(self, number: int) -> Channel:
        channel = self.index.channels[number]
        schema = self.index.schemas.get(channel.schema_id)
        described = MessageSchema(schema.name, schema.encoding, schema.data) if schema else None
        return Channel(number, channel.topic, channel.message_encoding, described)

    def _queue(self, channels: set[int], places: range | None) -> list[_Queued]:
        """Chunks, messages outside chunks and losses, as a heap."""
        index, size = self.index, len(self.timeline)
        kept = range(size) if places is None else places
        queue = [
            _Queued(item.log_time, self.size, place - size, item) for place, item in index.rescued if place in kept
        ]
        if kept.stop >= size:
            queue += [_Queued(lost.log_time, self.size, number, lost) for number, lost in enumerate(index.lost)]
        for number, chunk in enumerate(self._chunks(channels)):
            inside = index.places[chunk.chunk_start_offset]
            if places is None or (inside.start < places.stop and inside.stop > places.start):
                queue.append(_Queued(chunk.message_start_time, chunk.chunk_start_offset, number - size, chunk))
        following = self._unchunked(channels, places)
        if (first := next(following, None)) is not None:
            queue.append(_Queued(first[0], -1, first[1], first[2], following))
        heapify(queue)
        return queue

    def _in_order(
        self, chunk: ChunkIndex, channels: set[int], places: range | None, opened: OpenChunks
    ) -> Iterator[Ordered]:
        """The messages of a chunk in log-time order, or those lost with it."""
        inside = self._chunk_or_lost(chunk, opened)
        first = self.index.places[chunk.chunk_start_offset].start
        own = range(len(inside)) if places is None else range(max(places.start - first, 0), max(places.stop - first, 0))
        if isinstance(inside, ChunkMessages):
            return inside.in_order(channels, own)
        return iter(sorted((item.log_time, n, item) for n, item in enumerate(inside) if n in own))

    def _unchunked(self, channels: set[int], places: range | None, max_bytes: int | None = None) -> Iterator[Ordered]:
        """The messages outside chunks in log-time order. max_bytes: so many bytes of each; None: all."""
        outside, offsets, sizes = self.index.unchunked
        if not outside:
            return
        # No copies: there may be millions.
        all_places, times = np.frombuffer(outside, np.uint32), np.asarray(self.index.counted_times, np.uint64)
        own, kept = self.timeline.channels[all_places], range(len(outside))
        if places is not None:
            kept = range(*np.searchsorted(all_places, np.array([places.start, places.stop], np.uint32)))
        for number in in_log_time_order(own, lambda numbers: times[all_places[numbers]], channels, kept):
            channel, log_time, size = int(own[number]), int(times[all_places[number]]), sizes[number]
            lost = too_long(channel, log_time, size)
            data = b"" if lost else read_at(self._file, offsets[number], min(size, max_bytes or size))
            yield log_time, number, lost or RawMessage(channel, log_time, memoryview(data))

    def _chunks(self, channels: set[int]) -> list[ChunkIndex]:
        """The chunks with messages of the channels (or of unknown channels), in file order."""
        chunks = sorted(self.index.chunks, key=lambda chunk: chunk.chunk_start_offset)
        return [c for c in chunks if not c.message_index_offsets or channels & c.message_index_offsets.keys()]

    def _chunk_or_lost(self, chunk: ChunkIndex, opened: OpenChunks | None = None) -> ChunkMessages | list[LostMessage]:
        """The messages of a chunk, or a `LostMessage` for each entry of its message index."""
        opened = opened or OpenChunks(self._recent.records)
        try:
            return ChunkMessages(chunk, opened, self._last_table.of(chunk, opened))
        except PARSE_ERRORS as error:
            reason = lost_chunk(chunk.chunk_start_offset, error)
        channels = chunk.message_index_offsets
        known = [column.tolist() for column in self._message_index(chunk)[:2]]
        known = known if known[0] else [list(channels), [chunk.message_start_time] * len(channels)]
        lost = [LostMessage(channel, log_time, reason) for channel, log_time in zip(*known, strict=True)]
        return lost or [LostMessage(None, chunk.message_start_time, reason)]

    def _unpacked(self, chunk: ChunkIndex) -> bytes | memoryview:
        """The records of a chunk."""
        length = chunk.chunk_length - RECORD.size
        head = read_at(self._file, chunk.chunk_start_offset, RECORD.size)
        if len(head) < RECORD.size or RECORD.unpack(head) != (int(Opcode.CHUNK), length):
            raise ValueError("there is no chunk at the offset in the index")
        content = read_at(self._file, chunk.chunk_start_offset + RECORD.size, min(length, MAX_CHUNK_BYTES))
        return unpack_chunk(content)

    def _message_index(self, chunk: ChunkIndex) -> tuple[NDArray[np.uint16], NDArray[np.uint64], NDArray[np.uint64]]:
        """Channel, log time and offset of each message of a chunk, in file order; empty without a message index."""
        channels, entries = [np.zeros(0, np.uint16)], [np.zeros((0, 2), np.uint64)]
        first = chunk.chunk_start_offset + chunk.chunk_length
        with suppress(*PARSE_ERRORS):
            section = read_at(self._file, first, min(chunk.message_index_length, MAX_CHUNK_BYTES))
            for opcode, content in iter_records(section):
                if opcode == Opcode.MESSAGE_INDEX:
                    channel, size = struct.unpack_from("<HI", content)
                    entries.append(np.frombuffer(content, "<u8", size // 16 * 2, 6).reshape(-1, 2))
                    channels.append(np.full(len(entries[-1]), channel, np.uint16))
            times, offsets = np.concatenate(entries).T
            order = np.argsort(offsets, kind="stable")
            return np.concatenate(channels)[order], times[order], offsets[order]
        return channels[0], entries[0][:, 0], entries[0][:, 1]

    def _unaccounted(self, found: dict[int, int]) -> Iterator[LostMessage]:
        """The messages that the file's statistics count but that were neither read nor reported as lost."""
        if any(item.channel is None for item in self.index.lost):
            return
        for channel, count in sorted(found.items()):
            if (stated := self.index.stated_counts.get(channel, count)) > count:
                why = f"the log's statistics count {counted(stated, 'message')}, but the log contains {count}"
                yield LostMessage(channel, self.end, why)

    def _time_range(self) -> tuple[int, int]:
        """Log time of the first and the last message, ns."""
        index = self.index
        if not index.counted_times and (index.walked or not any(index.stated_counts.values())):
            damage = f" that can be read: {index.lost[0].reason}" if index.lost else "; record it again"
            raise LogError(f"{self.path} contains no messages{damage}")
        if index.walked:
            ends = [min(index.counted_times), max(index.counted_times)]
        else:
            filled = [chunk for chunk in index.chunks if chunk.message_end_time] or index.chunks
            ends = [end for chunk in filled for end in (chunk.message_start_time, chunk.message_end_time)]
        if max(ends) > MAX_LOG_TIME:
            ends = self.times(set(index.channels)).tolist()
        if not ends:
            raise LogError(f"{self.path} contains no message with a valid log time; record it again")
        return min(ends), max(ends)


def iter_decoded(
    path: Path, topics: Iterable[str] | None = None, lost: Counter[str] | None = None, part: Edges = (None, None)
) -> Iterator[tuple[str, int, Any]]:
    """Topic, log time in ns and decoded message of an MCAP log's ROS 2 CDR messages, in log-time order.

    topics: those to read, by default all in CDR; lost: counts the reasons why messages were lost; part: of the log, by
    default all. Raises LogError at the first message that cannot be read, unless `lost` is given.
    """
    with McapFile(Path(path)) as log:
        yield from decoded(log, topics, lost, part)


def decoded(
    log: McapFile | Recording, topics: Iterable[str] | None, lost: Counter[str] | None, part: Edges = (None, None)
) -> Iterator[tuple[str, int, Any]]:
    """The same of an opened log."""

    def lose(why: str) -> None:
        if lost is None:
            raise LogError(f"{log.path}: {why}")
        lost[why] += 1

    wanted, decoders = None if topics is None else set(topics), dict[int, Callable[[bytes | memoryview], Any]]()
    for number, channel in log.channels.items():
        schema = channel.schema
        if schema and channel.message_encoding == "cdr" and (wanted is None or channel.topic in wanted):
            decoders[number] = decoder_for(schema.name, schema.encoding, schema.text)
    for item in log.messages(set(decoders), *part):
        if isinstance(item, LostMessage):
            lose(item.reason)
            continue
        topic = log.channels[item.channel].topic
        try:
            message = decoders[item.channel](item.data)
        except Exception as error:  # foreign bytes may fail a codec in any way
            lose(f"{topic} at {item.log_time} ns cannot be decoded ({sentence_of(error)})")
            continue
        yield topic, item.log_time, message
