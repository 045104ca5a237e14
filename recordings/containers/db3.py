"""Reads a rosbag2 SQLite file (.db3). It is opened as immutable, so nothing is written beside it.

Messages are fetched one by one, so memory does not depend on the size of the file, and a broken row loses itself alone.
"""

from __future__ import annotations

import shlex
import sqlite3
from array import array
from collections.abc import Iterator
from contextlib import suppress
from functools import cached_property
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flow.contracts import counted
from recordings.containers.container import (
    HEAD_BYTES,
    MAX_STORED_BYTES,
    Channel,
    Container,
    LostMessage,
    MessageSchema,
    RawMessage,
)
from recordings.containers.timeline import Places, Timeline
from recordings.errors import LogError, sentence_of

_ROWS_AT_ONCE = 1000
_CHECKPOINT = "import sqlite3, sys; sqlite3.connect(sys.argv[1]).execute('PRAGMA wal_checkpoint')"


class Db3File(Container):
    """A rosbag2 SQLite file open for reading.

    A file of ROS 2 Humble or earlier has no definitions of its types; their texts are empty then. Raises LogError for a
    file without readable messages.
    """

    profile = "ros2"
    indexed = True

    def __init__(self, path: Path) -> None:
        self.path, self.size = path, path.stat().st_size
        self.lost: list[LostMessage] = []
        uri = f"{path.absolute().as_uri()}?immutable=1&mode=ro"
        self._database = sqlite3.connect(uri, uri=True, check_same_thread=False)
        try:
            self._database.execute("PRAGMA writable_schema = ON")  # otherwise nothing of a cut file is read
            self.channels = self._read_channels()
            self._rows = self._read_columns()
            self.timeline = Timeline(self._rows[1], np.maximum(self._rows[2], -1, out=self._rows[2]))
            self.start, self.end = self._ends(self._unwritten)
            if self._unwritten:
                self.lost.append(LostMessage(None, self.end, self._unwritten.removeprefix("; ")))
        except (sqlite3.Error, TypeError, ValueError, OverflowError) as error:  # a column may have any type
            self.close()
            raise LogError(f"{path} is not a rosbag2 recording or is damaged ({sentence_of(error)})") from error
        except BaseException:
            self.close()
            raise

    def heads(self, channels: set[int]) -> Iterator[RawMessage | LostMessage]:
        """The first bytes of the messages of some channels, with their headers."""
        return chain(self.read(self.timeline.places_of(channels), HEAD_BYTES), self.lost)

    def read(self, places: Places, size: int = MAX_STORED_BYTES) -> Iterator[RawMessage | LostMessage]:
        """The first `size` bytes of the messages at some places of the timeline."""
        return self._read_each(places, lambda place: self._data_or_reason(int(self._rows[0][place]), size))

    def close(self) -> None:
        """Close the file."""
        self._database.close()

    def _read_channels(self) -> dict[int, Channel]:
        tables = {name for (name,) in self._database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"topics", "messages"} <= tables:
            raise LogError(
                f"{self.path} is an SQLite file, but no rosbag2 recording: it has no table of messages{self._unwritten}"
            )
        schemas = dict[str, MessageSchema]()
        if "message_definitions" in tables:  # from ROS 2 Iron on
            columns = "topic_type, encoding, encoded_message_definition"
            with suppress(sqlite3.DatabaseError):  # in a cut file; the standard types are known
                for name, encoding, text in self._database.execute(f"SELECT {columns} FROM message_definitions"):
                    schemas[str(name)] = MessageSchema(str(name), str(encoding), _bytes(text))
        rows = self._database.execute("SELECT id, name, type, serialization_format FROM topics")
        return {
            int(number): Channel(
                int(number), str(topic), str(encoding), schemas.get(str(kind), MessageSchema(str(kind), "ros2msg", b""))
            )
            for number, topic, kind, encoding in rows
        }

    def _read_columns(self) -> tuple[NDArray[np.int64], ...]:
        """Row, channel and log time, ns, of every message, in the order of recording."""
        columns, damage = (array("q"), array("q"), array("q")), ""
        try:
            with suppress(sqlite3.Error):
                damage = self._read_rows(columns, _ROWS_AT_ONCE)
            damage = self._read_rows(columns, 1) or damage  # what an error cut off
        except sqlite3.Error as error:
            damage = sentence_of(error)
        if damage:
            reason = f"the file is truncated or damaged ({damage}); intact: {counted(len(columns[0]), 'message')}"
            self.lost.append(LostMessage(None, max(columns[2], default=0), reason))
        found = tuple(np.frombuffer(column, np.int64) for column in columns)
        for number in sorted(set(found[1].tolist()) - self.channels.keys()):
            unknown = counted(int((found[1] == number).sum()), "message")
            reason = f"{unknown} of topic {number} cannot be read: the file does not define it"
            self.lost.append(LostMessage(None, max(columns[2], default=0), reason))
        return found

    def _read_rows(self, columns: tuple[array[int], ...], at_once: int) -> str:
        """Add the rows after those in `columns`; an error loses less than `at_once` rows before it.

        Returns what is wrong with rows that were left out, or an empty text. SQLite reads the missing half of a page as
        rows of NULL, even where the table forbids it.
        """
        found = self._database.execute(
            "SELECT rowid, CAST(topic_id AS INTEGER), CAST(timestamp AS INTEGER) FROM messages NOT INDEXED "
            "WHERE rowid > ? ORDER BY rowid",
            (columns[0][-1] if columns[0] else -1 << 63,),
        )
        damage = ""
        while rows := found.fetchmany(at_once):
            if whole := [row for row in rows if None not in row]:
                for column, values in zip(columns, zip(*whole, strict=True), strict=True):
                    column.extend(values)
            if len(whole) < len(rows):
                damage = "rows without a topic or a time"
        return damage

    def _data_or_reason(self, row: int, size: int) -> memoryview | str:
        """The first `size` bytes of the message in a row, or why it is lost."""
        try:
            with self._database.blobopen("messages", "data", row, readonly=True) as blob:
                if len(blob) > MAX_STORED_BYTES:  # known without reading it
                    return f"row {row} of the file has {len(blob)} bytes; the limit is {MAX_STORED_BYTES}"
                return memoryview(blob.read(size))
        except (sqlite3.Error, ValueError, OverflowError) as error:
            return f"row {row} of the file is broken ({sentence_of(error)})"

    @cached_property
    def _unwritten(self) -> str:
        """The end of a sentence, if a stopped recorder left messages in a file of its own; else empty."""
        waiting = self.path.with_name(f"{self.path.name}-wal")
        if not (waiting.exists() and waiting.stat().st_size):
            return ""
        command = f'python3 -c "{_CHECKPOINT}" {shlex.quote(str(self.path))}'
        return f"; the recorder was stopped and {waiting.name} has messages that are not read; `{command}` adds them"


def _bytes(value: object) -> bytes:
    return value if isinstance(value, bytes) else str(value).encode()
