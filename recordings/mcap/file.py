"""Reads the messages of an MCAP file in log-time order, even if the file is damaged.

Chunks are opened when a message is due, so memory holds only those that overlap. CRCs are always checked. A broken
chunk loses its own messages and a cut file what was cut; a `LostMessage` stands for them, and reading continues.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from flow.contracts import counted
from recordings.containers.container import (
    HEAD_BYTES,
    MAX_STORED_BYTES,
    Channel,
    Container,
    LostMessage,
    MessageSchema,
    OpenChunks,
    RawMessage,
    blocks,
)
from recordings.containers.recording import Recording
from recordings.containers.timeline import Places, Timeline
from recordings.errors import LogError, sentence_of
from recordings.mcap.chunk import (
    MAX_CHUNK_BYTES,
    ChunkTable,
    check_size,
    chunk_heads,
    unpack_chunk,
    unpack_cut_chunk,
)
from recordings.mcap.index import (
    MESSAGE,
    PARSE_ERRORS,
    RECORD,
    StoredChunk,
    index_from_summary,
    lost_chunk,
    message_index,
    opened,
    read_at,
)
from recordings.mcap.walk import walk
from recordings.ros2.cdr import decoder_for, is_packed

_RECENT, _RECENT_BYTES = 6, 5_000_000  # chunks of so many bytes that are kept for the next topic

Edges = tuple[int | None, int | None]  # log times, ns, from which and before which messages are read


class McapFile(Container):
    """An MCAP file open for reading; use it as a context manager.

    index: where chunks and messages are. Raises LogError if the file does not exist, is not an MCAP file or contains no
    messages.

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
        self._recent = lru_cache(maxsize=_RECENT)(self._unpacked)
        self._large: tuple[int, ChunkTable | str] | None = None  # number and table of the last larger chunk
        try:
            self.size = self.path.stat().st_size
            self.index = index = index_from_summary(self._file, self.size) or walk(self._file, self.size)
            self.profile, self.indexed, self.lost = index.profile, not index.walked, index.lost
            self.channels = {number: self._channel(number) for number in index.channels}
            counts = index.counts()
            for number in sorted(counts.keys() - self.channels.keys()):
                unknown = counted(counts[number], "message")
                index.note_damage(f"{unknown} of channel {number} cannot be read: the log does not define it")
            for number, stated in sorted(index.stated_counts.items()):
                if stated > (count := counts.get(number, 0)) and all(item.channel is not None for item in self.lost):
                    why = f"the log's statistics count {counted(stated, 'message')}, but the log contains {count}"
                    self.lost.append(LostMessage(number, index.latest, why))
            check_size(self.path, self.size, sum(chunk.unpacked for chunk in index.chunks))
            self.timeline = Timeline.of(index.message_channels, index.message_times)
            self.start, self.end = self._ends()
        except BaseException:
            self._file.close()
            raise

    def channels_of(self, topics: Iterable[str]) -> set[int]:
        """The channels of some topics; a topic may have several."""
        wanted = set(topics)
        return {number for number, channel in self.channels.items() if channel.topic in wanted}

    def heads(self, channels: set[int]) -> Iterator[RawMessage | LostMessage]:
        """The first bytes of the messages of some channels, in file order, without checking CRCs.

        Messages that are compressed one by one, and those of a file without an index, are read as a whole.
        """
        if self.index.walked:
            yield from self.messages(channels)
            return
        wanted = np.isin(self.timeline.channels, sorted(channels))
        for chunk in self.index.chunks:
            inside = np.flatnonzero(wanted[chunk.places.start : chunk.places.stop])
            try:
                yield from list(self._chunk_heads(chunk, inside) if len(inside) else ())
            except PARSE_ERRORS:
                yield from self.read(chunk.places.start + inside)
        yield from self.lost

    def _chunk_heads(self, chunk: StoredChunk, inside: NDArray[np.intp]) -> Iterator[RawMessage]:
        found = message_index(self._file, chunk.offset + chunk.length, chunk.index_length)
        numbers, times, offsets = (column[inside].tolist() for column in found)
        records = chunk_heads(self._file, chunk.offset + RECORD.size, offsets, RECORD.size + MESSAGE.size + HEAD_BYTES)
        for number, time, record in zip(numbers, times, records, strict=True):
            data = memoryview(record)[RECORD.size + MESSAGE.size :]
            if record[:1] != bytes([Opcode.MESSAGE]) or is_packed(data):
                raise ValueError("there is no message of known start at the offset in the index")
            length = RECORD.unpack_from(record)[1] - MESSAGE.size
            yield RawMessage(number, time, data[:length])

    def times(self, channels: set[int]) -> NDArray[np.int64]:
        """The sorted log times of some channels, ns."""
        return self.timeline.times_of(channels)

    def close(self) -> None:
        """Close the file."""
        self._recent.cache_clear()
        self._large = None
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

    def read(self, places: Places) -> Iterator[RawMessage | LostMessage]:
        """The messages at some places of the timeline."""
        timeline, chunks = self.timeline, self.index.chunks
        of_chunk = np.searchsorted([chunk.places.start for chunk in chunks], places, "right") - 1
        opened = OpenChunks(of_chunk, self._table)
        for block, numbers in zip(blocks(places), blocks(of_chunk), strict=True):
            columns = block, numbers, timeline.channels[block], timeline.log_times[block]
            for place, number, channel, log_time in zip(*(column.tolist() for column in columns), strict=True):
                yield _message(opened.of_next(number), place - chunks[number].places.start, channel, log_time)

    def _table(self, number: int) -> ChunkTable | str:
        """The unpacked chunk of a number, or why it is broken."""
        chunk = self.index.chunks[number]
        if chunk.unpacked <= _RECENT_BYTES:
            return self._recent(chunk)
        if self._large is None or self._large[0] != number:
            self._large = None  # first, so that no two are in memory
            self._large = number, self._unpacked(chunk)
        return self._large[1]

    def _unpacked(self, chunk: StoredChunk) -> ChunkTable | str:
        part, index = slice(chunk.places.start, chunk.places.stop), self.index
        stated = np.array([index.message_channels[part], index.message_times[part]], np.uint64)
        try:
            records = memoryview(read_at(self._file, chunk.offset, min(chunk.length, MAX_CHUNK_BYTES)))
            if not chunk.is_bare:
                if RECORD.unpack_from(records) != (int(Opcode.CHUNK), chunk.length - RECORD.size) and not chunk.is_cut:
                    raise ValueError("there is no chunk at the offset in the index")
                records = memoryview((unpack_cut_chunk if chunk.is_cut else unpack_chunk)(records[RECORD.size :]))
            return ChunkTable(records, chunk.is_cut, stated)
        except PARSE_ERRORS as error:
            return lost_chunk(chunk.offset, error)


def _message(chunk: ChunkTable | str, number: int, channel: int, log_time: int) -> RawMessage | LostMessage:
    """A message of a chunk, or its loss, also if the index has another log time: no CRC covers that."""
    if isinstance(chunk, str):
        return LostMessage(channel, log_time, chunk)
    found = RawMessage(channel, *chunk.message(number))
    if found.log_time != log_time:
        return LostMessage(channel, log_time, "the message is lost: its log time in the message index is wrong")
    if len(found.data) > MAX_STORED_BYTES:
        why = f"the message has {len(found.data)} bytes; the limit is {MAX_STORED_BYTES}"
        return LostMessage(channel, found.log_time, why)
    return found


def iter_decoded(
    path: Path, topics: Iterable[str] | None = None, lost: Counter[str] | None = None, part: Edges = (None, None)
) -> Iterator[tuple[str, int, Any]]:
    """Topic, log time in ns and decoded message of an MCAP log's ROS 2 CDR messages, in log-time order.

    topics: those to read, by default all in CDR; lost: counts the reasons why messages were lost; part: of the log, by
    default all. Raises LogError at the first message that cannot be read, unless `lost` is given.
    """
    with McapFile(Path(path)) as log:
        yield from decoded(log, topics, lost, part)


def by_stamp(
    path: Path, topics: Iterable[str], lost: Counter[str] | None = None, part: Edges = (None, None)
) -> Iterator[tuple[int, dict[str, list[Any]]]]:
    """Each stamp (log time, ns) of a result log, and topic -> its messages there: /tf and diagnostics have several."""
    for stamp, group in groupby(iter_decoded(path, topics, lost, part), key=lambda item: item[1]):
        messages = dict[str, list[Any]]()
        for topic, _, message in group:
            messages.setdefault(topic, []).append(message)
        yield stamp, messages


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
