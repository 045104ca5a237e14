"""Reads the messages of an MCAP file in log-time order, even if the file is damaged.

Chunks wait in a queue by their start time and are opened one after the other, so memory holds only those that overlap.
CRCs are always checked. A broken chunk loses its own messages and a cut file what was cut; a `LostMessage` stands for
them, and reading continues.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import cached_property
from heapq import heapify, heappop, heappush
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex
from numpy.typing import NDArray

from flow.contracts import counted
from recordings.containers.container import Channel, LostMessage, MessageSchema, RawMessage
from recordings.containers.timeline import MAX_LOG_TIME, Timeline
from recordings.containers.unpacking import ZSTD_MAGIC
from recordings.errors import LogError, sentence_of
from recordings.mcap.chunk import MAX_CHUNK_BYTES, chunk_heads, unpack_chunk
from recordings.mcap.index import (
    MAGIC,
    MESSAGE,
    PARSE_ERRORS,
    RECORD,
    UnchunkedMessage,
    index_from_summary,
    iter_records,
    lost_chunk,
    parse_message,
    read_at,
)
from recordings.mcap.walk import walk
from recordings.ros2.cdr import decoder_for

HEAD_BYTES = 64  # of a message; they contain the stamp of its header


class McapFile:
    """An MCAP file open for reading; use it as a context manager.

    Parameters
    ----------
    path : Path
        The file.

    Attributes
    ----------
    start, end : int
        Log time of the first and the last message, ns.
    channels : dict of int to Channel
        The channels by number, each with its encoding and schema.
    size : int
        Bytes.
    index : Index
        Where chunks and messages are.

    Raises
    ------
    LogError
        If the file does not exist, is not an MCAP file or contains no messages.

    Examples
    --------
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
        self._file = _opened(self.path)
        try:
            self.size = self.path.stat().st_size
            self.index = index_from_summary(self._file, self.size) or walk(self._file, self.size)
            self.channels = {number: self._channel(number) for number in self.index.channels}
            for number in sorted(set(self.index.counted_channels) - self.channels.keys()):
                unknown = counted(self.index.counted_channels.count(number), "message")
                self.index.note_damage(f"{unknown} of channel {number} cannot be read: the log does not define it")
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
        found = dict.fromkeys(channels, 0)
        while queue and queue[0][0] < high:
            log_time, _, _, item = heappop(queue)
            if isinstance(item, ChunkIndex):
                if item.message_end_time >= low:
                    self._open_chunk(item, queue, places)
            elif item.channel is None or item.channel in channels:
                if item.channel is not None:
                    found[item.channel] += 1
                if log_time > MAX_LOG_TIME:
                    damage = f"the message is lost: its log time is damaged ({log_time} ns)"
                    yield LostMessage(item.channel, self.end, item.reason if isinstance(item, LostMessage) else damage)
                elif log_time >= low:
                    yield self._read_unchunked(item) if isinstance(item, UnchunkedMessage) else item
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
        for item in self.index.unchunked:
            if item.channel in channels:
                yield self._read_unchunked(item._replace(size=min(item.size, HEAD_BYTES)))
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
            if record[:1] != bytes([Opcode.MESSAGE]) or data[:4] == ZSTD_MAGIC:
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
            return int(np.isin(self.timeline.channels, list(channels)).sum())
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

    def _queue(self, channels: set[int], places: range | None) -> list[tuple[int, int, int, Any]]:
        """Chunks, messages and losses, as a heap of (log time, offset in the file, place in a chunk, item)."""
        index, kept = self.index, range(len(self.timeline)) if places is None else places
        queue: list[tuple[int, int, int, Any]] = []
        if kept.stop >= len(self.timeline):
            queue += [(lost.log_time, self.size, number, lost) for number, lost in enumerate(index.lost)]
        queue += [(item.log_time, self.size, place - (1 << 62), item) for place, item in index.rescued if place in kept]
        queue += [
            (item.log_time, item.offset, -1, item)
            for item in index.unchunked
            if item.channel in channels and item.place in kept
        ]
        for chunk in self._chunks(channels):
            inside = index.places[chunk.chunk_start_offset]
            if places is None or (inside.start < places.stop and inside.stop > places.start):
                queue.append((chunk.message_start_time, chunk.chunk_start_offset, -1, chunk))
        heapify(queue)
        return queue

    def _open_chunk(self, chunk: ChunkIndex, queue: list[tuple[int, int, int, Any]], places: range | None) -> None:
        """Add the messages of a chunk to the queue."""
        first = self.index.places[chunk.chunk_start_offset].start
        for number, item in enumerate(self._chunk_or_lost(chunk)):
            if places is None or first + number in places:
                heappush(queue, (item.log_time, chunk.chunk_start_offset, number, item))

    def _chunks(self, channels: set[int]) -> list[ChunkIndex]:
        """The chunks with messages of the channels (or of unknown channels), in file order."""
        chunks = sorted(self.index.chunks, key=lambda chunk: chunk.chunk_start_offset)
        return [c for c in chunks if not c.message_index_offsets or channels & c.message_index_offsets.keys()]

    def _chunk_or_lost(self, chunk: ChunkIndex) -> Sequence[RawMessage | LostMessage]:
        """The messages of a chunk, or a `LostMessage` for each entry of its message index."""
        try:
            return self._chunk_messages(chunk)
        except PARSE_ERRORS as error:
            reason = lost_chunk(chunk.chunk_start_offset, error)
        channels = chunk.message_index_offsets
        known = [column.tolist() for column in self._message_index(chunk)[:2]]
        known = known if known[0] else [list(channels), [chunk.message_start_time] * len(channels)]
        lost = [LostMessage(channel, log_time, reason) for channel, log_time in zip(*known, strict=True)]
        return lost or [LostMessage(None, chunk.message_start_time, reason)]

    def _chunk_messages(self, chunk: ChunkIndex) -> list[RawMessage]:
        length = chunk.chunk_length - RECORD.size
        head = read_at(self._file, chunk.chunk_start_offset, RECORD.size)
        if len(head) < RECORD.size or RECORD.unpack(head) != (int(Opcode.CHUNK), length):
            raise ValueError("there is no chunk at the offset in the index")
        content = read_at(self._file, chunk.chunk_start_offset + RECORD.size, min(length, MAX_CHUNK_BYTES))
        inside = iter_records(unpack_chunk(content))
        return [parse_message(content) for opcode, content in inside if opcode == Opcode.MESSAGE]

    def _read_unchunked(self, place: UnchunkedMessage) -> RawMessage:
        return RawMessage(place.channel, place.log_time, memoryview(read_at(self._file, place.offset, place.size)))

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
    path: Path, topics: Iterable[str] | None = None, lost: Counter[str] | None = None
) -> Iterator[tuple[str, int, Any]]:
    """Read a log's ROS 2 CDR messages in log-time order.

    Parameters
    ----------
    path : Path
        The MCAP file.
    topics : iterable of str, optional
        The topics to read; by default all in CDR.
    lost : Counter, optional
        Counts the reasons why messages were lost.

    Yields
    ------
    tuple of (str, int, object)
        Topic, log time in ns, decoded message.

    Raises
    ------
    LogError
        At the first message that cannot be read, unless `lost` is given.
    """

    def lose(why: str) -> None:
        if lost is None:
            raise LogError(f"{path}: {why}")
        lost[why] += 1

    wanted = None if topics is None else set(topics)
    with McapFile(Path(path)) as log:
        decoders: dict[int, Callable[[bytes | memoryview], Any]] = {}
        for number, channel in log.channels.items():
            schema = channel.schema
            if schema and channel.message_encoding == "cdr" and (wanted is None or channel.topic in wanted):
                decoders[number] = decoder_for(schema.name, schema.encoding, schema.text)
        for item in log.messages(set(decoders)):
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


def _opened(path: Path) -> BinaryIO:
    """The open file, if it begins like an MCAP file."""
    if path.is_dir():
        raise LogError(f"{path} is a folder; give the .mcap file in it")
    if path.exists() and not path.is_file():
        raise LogError(f"{path} is a pipe or a device; give a .mcap file")
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
    raise LogError(f"{path} is not an MCAP log (its first bytes differ); give a .mcap file")
