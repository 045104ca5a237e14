"""Reads the messages of an MCAP file in log-time order, even if the file is damaged.

Chunks wait in a queue by their start time and are opened one after the other, so memory holds only those that overlap.
CRCs are always checked. A broken chunk loses its own messages and a cut file what was cut; a `LostMessage` stands for
them, and reading continues.
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
from mcap.records import ChunkIndex
from numpy.typing import NDArray

from flow.contracts import counted
from recordings.containers.container import Channel, LostMessage, MessageSchema, RawMessage
from recordings.errors import LogError, sentence_of
from recordings.mcap.chunk import MAX_CHUNK_BYTES, unpack_chunk
from recordings.mcap.index import (
    MAGIC,
    MAX_JITTER_NS,
    MAX_LOG_TIME,
    PARSE_ERRORS,
    RECORD,
    Clock,
    T,
    UnchunkedMessage,
    index_from_summary,
    iter_records,
    lost_chunk,
    parse_message,
    read_at,
    reject_set_back,
)
from recordings.mcap.walk import walk
from recordings.ros2.cdr import decoder_for

# Converts a ROS 1 bag to ROS 2 messages; `mcap convert` keeps it in ROS 1.
CONVERT = "rosbags-convert --src IN.bag --dst OUT --dst-storage mcap"


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
            for number in self.index.times.keys() - self.index.channels.keys():
                unknown = counted(len(self.index.times[number]), "message")
                self.index.note_damage(f"{unknown} of channel {number} cannot be read: the log does not define it")
            self.channels = {number: self._channel(number) for number in self.index.channels}
            self.start, self.end = self._time_range()
        except BaseException:
            self._file.close()
            raise

    def channels_of(self, topics: Iterable[str]) -> set[int]:
        """The channels of some topics; a topic may have several."""
        wanted = set(topics)
        return {number for number, channel in self.channels.items() if channel.topic in wanted}

    def messages(
        self, channels: set[int], start: int | None = None, end: int | None = None, allow_unordered: bool = False
    ) -> Iterator[RawMessage | LostMessage]:
        """Read the messages of `channels` with start <= log time < end, ns, in log-time order (ties: in file order).

        A `LostMessage` stands at the log time of lost messages; if that time itself is damaged, at the end. After the
        clock of a channel was set back, its messages are lost until 1 s beyond the old time. With `allow_unordered`
        they are kept, because a log may also be written topic by topic.
        """
        low, high = (0 if start is None else start), (1 << 64 if end is None else end)
        ordered = set[int]() if allow_unordered else channels
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
                if log_time > MAX_LOG_TIME:
                    damage = f"the message is lost: its log time is damaged ({log_time} ns)"
                    yield LostMessage(item.channel, self.end, item.reason if isinstance(item, LostMessage) else damage)
                elif log_time >= low:
                    yield self._read_unchunked(item) if isinstance(item, UnchunkedMessage) else item
        if start is None and end is None:
            yield from self._unaccounted(found)

    def times(self, channels: set[int]) -> NDArray[np.int64]:
        """The sorted log times of some channels, ns; an indexed file is not decompressed for them.

        Times that repeat because the clock was set back are left out.
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
            times = np.array([time for time in found[channel] if time <= MAX_LOG_TIME], np.int64)
            if np.any(np.maximum.accumulate(times) - times > MAX_JITTER_NS):
                clocks = accumulate(times.tolist(), Clock.advanced, initial=Clock())
                times = times[[not clock.set_back for clock in clocks][1:]]
            kept.append(times)
        return np.sort(np.concatenate(kept))

    def count(self, channels: set[int]) -> int:
        """The number of messages in some channels, from the file's statistics or the walk."""
        index = self.index
        if index.walked:
            return sum(len(index.times.get(channel, ())) for channel in channels)
        return sum(index.stated_counts.get(channel, 0) for channel in channels)

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

    def _queue(self, channels: set[int], ordered: set[int]) -> list[tuple[int, int, int, Any]]:
        """Chunks, messages and losses, as a heap of (log time, offset in the file, place in a chunk, item)."""
        index = self.index
        queue: list[tuple[int, int, int, Any]] = []
        queue += [(lost.log_time, self.size, number, lost) for number, lost in enumerate(index.lost)]
        for number, (found, clock) in enumerate(index.rescued, -len(index.rescued)):
            queue.append((found.log_time, self.size, number, reject_set_back(found, [clock] if ordered else ())))
        unchunked = [item for item in index.unchunked if item.channel in channels]
        for place, item in zip(unchunked, _reject_set_back(unchunked, {}, ordered), strict=True):
            queue.append((item.log_time, place.offset, -1, item))
        queue += [(chunk.message_start_time, chunk.chunk_start_offset, -1, chunk) for chunk in self._chunks(channels)]
        heapify(queue)
        return queue

    def _chunks(self, channels: set[int]) -> list[ChunkIndex]:
        """The chunks with messages of the channels (or of unknown channels), in file order."""
        chunks = sorted(self.index.chunks, key=lambda chunk: chunk.chunk_start_offset)
        return [c for c in chunks if not c.message_index_offsets or channels & c.message_index_offsets.keys()]

    @cached_property
    def _clocks_before(self) -> dict[int, dict[int | None, Clock]]:
        """Chunk offset -> the clock of each channel where the chunk begins; empty if no chunk begins in the past."""
        if self.index.walked:
            return self.index.clocks_before
        chunks = [chunk for chunk in self._chunks(set(self.channels)) if chunk.message_end_time]
        ends = accumulate((chunk.message_end_time for chunk in chunks), max)
        if all(end - chunk.message_start_time <= MAX_JITTER_NS for end, chunk in zip(ends, chunks[1:], strict=False)):
            return {}
        before, clocks = dict[int, dict[int | None, Clock]](), defaultdict[int | None, Clock](Clock)
        for chunk in chunks:
            before[chunk.chunk_start_offset] = clocks.copy()
            for item in self._contents(chunk):
                clocks[item.channel] = clocks[item.channel].advanced(item.log_time)
        return before

    def _chunk_or_lost(self, chunk: ChunkIndex, ordered: Collection[int] = ()) -> list[RawMessage | LostMessage]:
        """The messages of a chunk, or a `LostMessage` for each entry of its message index."""
        try:
            before = self._clocks_before.get(chunk.chunk_start_offset, {}) if ordered else {}
            return _reject_set_back(self._chunk_messages(chunk), before, ordered)
        except PARSE_ERRORS as error:
            reason = lost_chunk(chunk.chunk_start_offset, error)
        channels = chunk.message_index_offsets
        known = self._message_index(chunk) or [(number, chunk.message_start_time) for number in channels]
        lost = [LostMessage(channel, log_time, reason) for channel, log_time in known]
        return [*lost] or [LostMessage(None, chunk.message_start_time, reason)]

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

    def _contents(self, chunk: ChunkIndex) -> list[RawMessage | LostMessage]:
        """A chunk's messages, without data if there is a message index; those of one channel are in file order."""
        known = self._message_index(chunk)
        return [RawMessage(number, time, memoryview(b"")) for number, time in known] or self._chunk_or_lost(chunk)

    def _message_index(self, chunk: ChunkIndex) -> list[tuple[int, int]]:
        """(channel, log time) of each message by the message index, in file order per channel; empty if broken."""
        found: list[tuple[int, int]] = []
        first = chunk.chunk_start_offset + chunk.chunk_length
        with suppress(*PARSE_ERRORS):
            section = read_at(self._file, first, min(chunk.message_index_length, MAX_CHUNK_BYTES))
            for opcode, content in iter_records(section):
                if opcode == Opcode.MESSAGE_INDEX:
                    channel, size = struct.unpack_from("<HI", content)
                    pairs = np.frombuffer(content, "<u8", size // 16 * 2, 6).reshape(-1, 2)
                    found.extend((channel, time) for time in pairs[pairs[:, 1].argsort(kind="stable"), 0].tolist())
            return found
        return []

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
        if not index.times and (index.walked or not any(index.stated_counts.values())):
            damage = f" that can be read: {index.lost[0].reason}" if index.lost else "; record it again"
            raise LogError(f"{self.path} contains no messages{damage}")
        if index.walked:
            ends = [end for times in index.times.values() for end in (min(times), max(times))]
        else:
            filled = [chunk for chunk in index.chunks if chunk.message_end_time] or index.chunks
            ends = [end for chunk in filled for end in (chunk.message_start_time, chunk.message_end_time)]
        if max(ends) > MAX_LOG_TIME:
            ends = self.times(set(index.channels)).tolist()
        if not ends:
            raise LogError(f"{self.path} contains no message with a valid log time; record it again")
        return min(ends), max(ends)


def _reject_set_back(
    messages: Iterable[T], clocks_before: Mapping[int | None, Clock], ordered: Collection[int]
) -> list[T | LostMessage]:
    """Replace each message that follows a set-back clock of a channel in `ordered` by a `LostMessage`."""
    clocks, found = defaultdict[int | None, Clock](Clock, clocks_before), list[T | LostMessage]()
    set_back = {channel for channel in ordered if channel in clocks and clocks[channel].set_back}
    for message in messages:
        clock = clocks[message.channel] = clocks[message.channel].advanced(message.log_time)
        if message.channel in ordered:
            (set_back.add if clock.set_back else set_back.discard)(message.channel)
        found.append(reject_set_back(message, [clocks[channel] for channel in set_back]) if set_back else message)
    return found


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
        for item in log.messages(set(decoders), allow_unordered=True):
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
    if start.startswith(b"#ROSBAG"):
        raise LogError(f"{path} is a ROS 1 bag; convert it to OUT/OUT.mcap first: {CONVERT}")
    if start.startswith(b"SQLite format 3"):
        raise LogError(f"{path} is a rosbag2 SQLite bag; convert it to MCAP first: mcap convert IN.db3 OUT.mcap")
    raise LogError(f"{path} is not an MCAP log (its first bytes differ); give a .mcap file")
