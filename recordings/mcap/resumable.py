"""Writes a log that an interruption leaves unfinished. The next writer finishes it, with the same bytes as one that
writes it at once.

The next writer gets all messages from the first one on. As long as the unfinished log contains them, nothing is
written. After its last whole chunk, or at the first message that differs, the log is cut, and writing goes on. Messages
that take long to make are passed over by topic and stamp: the mark in the name of the unfinished log stands for them.
"""

from __future__ import annotations

import fcntl
import os
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from os.path import samestat
from pathlib import Path
from typing import BinaryIO

from mcap.records import Schema

from recordings.atomic_write import temporary_name, writing
from recordings.containers.container import RawMessage
from recordings.errors import UnwritableError
from recordings.mcap.whole_chunks import WholeChunk, whole_chunks
from recordings.mcap.writer import MessageKind, Ros2Writer


class ResumableWriter(Ros2Writer):
    """A `Ros2Writer` whose unfinished log stays after an interrupt, a full disk or a kill, and is continued.

    mark: states what the log is made from; only an unfinished log of the same mark is continued. resumed: called once
    if there is an unfinished log, with True after its last message, with False at a message that differs or for another
    mark. Raises UnwritableError if the log cannot be written, or another writer of the same mark is at work.
    """

    def __init__(self, path: Path, mark: str, resumed: Callable[[bool], None] = lambda whole: None) -> None:
        self._mark, self._resumed = mark, resumed
        super().__init__(path)
        with writing(self.path):
            self._file.flush()
            self._end = self._file.tell()  # bytes before it stay in the log
            self._chunks = deque(whole_chunks(self._file, self._end))
            self._definitions: dict[int, Schema] = {}
            self._defined: dict[int, tuple[str, MessageKind]] = {}  # channel -> topic and type
            self._next = deque[tuple[int, int]]()  # channel and log time of the messages of the first chunk
            self._messages: Sequence[RawMessage] = ()  # all messages of that chunk; empty until one is compared
            #: The stamps of the messages in the unfinished log, ns, by topic; empty when it is used up.
            self.contained: Mapping[str, set[int]] = self._stamps()
            unfinished = bool(self._chunks)
            self._load()
        if not unfinished and self._others():
            resumed(False)

    def skip(self, topic: str, stamp: int) -> bool:
        """Pass over a message without its content; False if the unfinished log does not contain it there."""
        return self._is_next(topic, stamp)

    def add(
        self, topic: str, kind: MessageKind, stamp: int, data: bytes | memoryview, copy_of: int | None = None
    ) -> None:
        """Append one message as it is stored, unless the unfinished log contains it there."""
        if not self._is_next(topic, stamp, kind, data):
            super().add(topic, kind, stamp, data, copy_of)

    def close(self) -> None:
        """Finish the log and give it its name; unfinished logs of other marks are removed."""
        super().close()
        for other in self._others():
            with suppress(OSError), other.open("rb") as file:  # another writer has locked its own
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                other.unlink()

    def abort(self) -> None:
        """Discard the log, unless it is an unfinished one that was not changed yet."""
        if self._next:
            self._leave()
        super().abort()

    def __exit__(self, kind: object, *raised: object) -> None:
        if isinstance(kind, type) and issubclass(kind, KeyboardInterrupt) and any(self._counts.values()):
            self._leave()
        super().__exit__(kind, *raised)

    def _leave(self) -> None:
        """Close the unfinished log, and keep it."""
        with suppress(OSError):  # messages that are not in a chunk are made again
            self._file.close()

    def _temporary_name(self) -> Path:
        return temporary_name(self.path, f"import-{self._mark}")

    def _open(self) -> BinaryIO:
        file = os.fdopen(os.open(self._partial, os.O_RDWR | os.O_CREAT, 0o666), "r+b")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            free = samestat(self._partial.stat(), os.fstat(file.fileno()))  # else it was just given its name
        except BlockingIOError:
            free = False
        except OSError:  # the file system has no locks
            free = True
        if not free:
            file.close()
            raise UnwritableError(f"{self.path} is being written by another import; wait for it, or stop it")
        return file

    def _others(self) -> list[Path]:
        """Unfinished logs of other marks."""
        begin, end = f"{self.path.name}.import-", ".partial"
        names = (path for path in self.path.parent.iterdir() if path.name.startswith(begin))
        return [path for path in names if path.name.endswith(end) and path != self._partial]

    @contextmanager
    def _reporting(self) -> Iterator[None]:
        if self._next:  # something else follows than the unfinished log contains
            self._cut(whole=False)
        with super()._reporting():
            yield

    def _kept(self) -> str:
        return f" (what was written is in {self._partial}, and the same command continues it)"

    def _stamps(self) -> dict[str, set[int]]:
        topics = {number: channel.topic for chunk in self._chunks for number, channel in chunk.channels.items()}
        found: dict[str, set[int]] = {}
        for chunk in self._chunks:
            for number, time in chunk.listed:
                found.setdefault(topics[number], set()).add(time)
        return found

    def _is_next(
        self, topic: str, stamp: int, kind: MessageKind | None = None, data: bytes | memoryview | None = None
    ) -> bool:
        """Whether the unfinished log contains this message next; if not, it is cut there."""
        if not self._next:
            return False
        number, log_time = self._next[0]
        name, known = self._defined[number]
        same = (name, log_time) == (topic, stamp)
        if same and data is not None:
            same = (known, self._content()[-len(self._next)].data) == (kind, data)
        if not same:
            self._cut(whole=False)
            return False
        self._next.popleft()
        if not self._next:
            self._adopt(self._chunks.popleft())
            self._load()
        return True

    def _content(self) -> Sequence[RawMessage]:
        """The messages of the first chunk."""
        if not self._messages:
            self._messages = self._chunks[0].messages(self._file)
        return self._messages

    def _load(self) -> None:
        """Compare with the next chunk from now on; without one, write."""
        if not self._chunks:
            self._cut(whole=True)
            return
        chunk = self._chunks[0]
        self._definitions.update(chunk.schemas)
        for number, channel in chunk.channels.items():
            schema = self._definitions[channel.schema_id]
            kind = MessageKind(schema.name, channel.message_encoding, schema.encoding, schema.data)
            self._defined[number] = channel.topic, kind
        self._next.extend(chunk.listed)

    def _cut(self, whole: bool) -> None:
        """Cut the unfinished log after the chunks that are kept, and write from now on. whole: what `resumed` gets."""
        if self.contained:
            self._resumed(whole)
        same = self._content()[: -len(self._next)] if self._next else ()
        self._next.clear()
        self.contained = {}
        with self._reporting():
            self._file.seek(self._end)
            self._file.truncate()
        for message in same:
            topic, kind = self._defined[message.channel]
            super().add(topic, kind, message.log_time, message.data)

    def _adopt(self, chunk: WholeChunk) -> None:
        """Give the writers the state that they have after a chunk."""
        state = vars(self._writer)  # mcap's Writer has no other way to continue a file
        state["_Writer__schemas"].update(chunk.schemas)
        state["_Writer__channels"].update(chunk.channels)
        state["_Writer__chunk_indices"].append(chunk.index)
        statistics, times = state["_Writer__statistics"], [time for _, time in chunk.listed]
        if statistics.message_count == 0:
            statistics.message_start_time = times[0]
        statistics.message_start_time = min(statistics.message_start_time, *times)
        statistics.message_end_time = max(statistics.message_end_time, *times)
        statistics.schema_count += len(chunk.schemas)
        statistics.channel_count += len(chunk.channels)
        statistics.chunk_count += 1
        statistics.message_count += len(times)
        for number, _ in chunk.listed:
            statistics.channel_message_counts[number] += 1
            self._counts[number] = self._counts.get(number, 0) + 1
        for number, channel in chunk.channels.items():
            topic, kind = self._defined[number]
            self._channels[topic, None] = number, kind
            self._schemas[kind] = channel.schema_id
        self._end, self._messages = chunk.end, ()
