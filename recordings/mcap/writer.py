"""Writes ROS 2 messages into an MCAP log.

A large message gets a chunk of its own, so a reader of the small topics (tilt, calibration, transforms) decompresses no
images. The log gets its name when it is complete.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import groupby
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, Self

import mcap.writer
from isal import isal_zlib
from mcap.writer import CompressionType, Writer

from flow.contracts import counted
from recordings.atomic_write import give_name, temporary_name, unwritable, writing
from recordings.containers.container import Channel, RawMessage
from recordings.errors import LogError
from recordings.mcap.digests import Digests
from recordings.mcap.file import McapFile
from recordings.ros2.cdr import LAST_STAMP, standard_types

mcap.writer.zlib = isal_zlib  # type: ignore[attr-defined]  # the same checksums in a tenth of the time
MIN_OWN_CHUNK_BYTES = 64 * 1024  # of a message that gets a chunk of its own
COMPRESSIONS = {"lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD, "none": CompressionType.NONE}


# Late subscribers also get maps and static transforms. The form is that of ROS 2 Jazzy and later.
_FOREVER = "{sec: 9223372036, nsec: 854775807}"
_LATCHED = f"""- history: keep_last
  depth: 1
  reliability: reliable
  durability: transient_local
  deadline: {_FOREVER}
  lifespan: {_FOREVER}
  liveliness: automatic
  liveliness_lease_duration: {_FOREVER}
  avoid_ros_namespace_conventions: false
"""
_LATCHED_TYPES = ("grid_map_msgs/msg/GridMap", "nav_msgs/msg/OccupancyGrid")


class MessageKind(NamedTuple):
    """A type of messages. name: of the schema; text: the definition, which may be empty."""

    name: str
    message_encoding: str
    schema_encoding: str
    text: bytes


class Written(NamedTuple):
    """What a log contains at some moment. partials: the temporary names of the log, and of those that it continues;
    counts: topic -> number of messages, without copied ones."""

    partials: tuple[str, ...]
    counts: dict[str, int]


class Ros2Writer:
    """Writes messages as `ros2msg` / CDR, with log time = publish time = stamp. Same calls, same bytes.

    Use it as a context manager: it closes the log at the end, and discards it after an exception.

    keep: if the disk is full or writing fails, keep the messages so far under another name; compression: lz4, zstd or
    none. Raises UnwritableError if the log cannot be written.
    """

    profile = "ros2"

    def __init__(self, path: Path, keep: bool = False, compression: str = "zstd", digests: bool = False) -> None:
        self.path, self._keep = Path(path), keep
        self._kinds: dict[str, MessageKind] = {}
        self._schemas: dict[MessageKind, int] = {}
        self._channels: dict[tuple[str, int | None], tuple[int, MessageKind]] = {}
        self._counts: dict[int, int] = {}
        self._digests = Digests() if digests else None
        self._partial = self._temporary_name()
        self._continued: tuple[str, ...] = ()  # temporary names of logs that this one continues
        with writing(self.path):
            self._file = self._open()
        self._writer: Any = Writer(self._file, chunk_size=1024 * 1024, compression=COMPRESSIONS[compression])
        self._writer.start(profile=self.profile, library="roverflow")

    @property
    def closed(self) -> bool:
        """Whether the log is finished or discarded."""
        return self._file.closed

    def write(self, topic: str, message: Any, stamp: int) -> None:
        """Append one message at `stamp`, ns. All messages of a topic have the same type."""
        kind = message.__msgtype__
        if not 0 <= stamp < LAST_STAMP:
            raise ValueError(f"{kind} for {topic}: the stamp {stamp} ns is outside ROS time; give ns since 1970")
        self.add(topic, self._kind(kind), stamp, standard_types().serialize_cdr(message, kind))

    def add(
        self, topic: str, kind: MessageKind, stamp: int, data: bytes | memoryview, copy_of: int | None = None
    ) -> None:
        """Append one message as it is stored. copy_of: its channel in another log, which gets a channel of its own."""
        with self._reporting():
            channel = self._channel(topic, kind, copy_of)
            count = self._counts[channel] = self._counts.get(channel, 0) + 1
            large = len(data) >= MIN_OWN_CHUNK_BYTES
            if large:
                self._writer.flush()
            if self._digests is not None and copy_of is None:
                self._digests.add(topic, stamp, data)
            self._writer.add_message(channel, log_time=stamp, publish_time=stamp, data=data, sequence=count)
            if large:
                self._writer.flush()

    def flush(self) -> None:
        """Write what has come so far into the file; the next message begins a chunk."""
        with self._reporting():
            self._writer.flush()

    def written(self) -> Written:
        """What the log contains up to the last `flush`, which the file has by now."""
        own = {topic: number for (topic, copy_of), (number, _) in self._channels.items() if copy_of is None}
        counts = {topic: self._counts[number] for topic, number in own.items()}
        return Written((self._partial.name, *self._continued), counts)

    def continue_from(self, before: Written) -> None:
        """Copy what a log contained that is unfinished, or has got its name, and that was flushed after each stamp.

        Raises LogError if it is not all there.
        """
        self._continued, left = before.partials, Counter(before.counts)
        partial = self.path.with_name(before.partials[0])
        path = partial if partial.exists() else self.path
        for _, items in groupby(_messages_of(path, before.counts), lambda item: item[1].log_time):
            for channel, item in items:
                if left[channel.topic]:
                    left[channel.topic] -= 1
                    self.add(channel.topic, kind_of(channel), item.log_time, item.data)
            self.flush()
            if not left.total():
                break
        if left.total():
            missing = counted(left.total(), "message")
            raise LogError(f"{path} lacks {missing} of the run that is to be resumed; run without --resume")

    def digests(self) -> dict[str, str]:
        """Topic -> digest of its messages so far, without copied ones."""
        return self._digests.by_topic() if self._digests is not None else {}

    def attachment(self, name: str, media_type: str, content: bytes) -> None:
        """Append a file."""
        with self._reporting():
            self._writer.flush()
            self._writer.add_attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=content)

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Append one metadata record, its keys in sorted order."""
        with self._reporting():
            self._writer.flush()
            self._writer.add_metadata(name, dict(sorted(values.items())))

    def close(self) -> None:
        """Finish the log and give it its name. Closing twice does nothing."""
        if self._file.closed:
            return
        with self._reporting():
            self._writer.finish()
            self._file.flush()
            give_name(self._partial, self.path)
            self._file.close()
            for earlier in self._continued:
                self.path.with_name(earlier).unlink(missing_ok=True)

    def abort(self) -> None:
        """Discard the log; an earlier file at `path` stays. After `close`, does nothing."""
        if self._file.closed:
            return
        with suppress(OSError):  # it is discarded anyway
            self._file.close()
        self._partial.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *raised: object) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()

    def _temporary_name(self) -> Path:
        return temporary_name(self.path)

    def _open(self) -> BinaryIO:
        return self._partial.open("wb")

    def _kind(self, name: str) -> MessageKind:
        """A standard type by its name."""
        if name not in self._kinds:
            text, _ = standard_types().generate_msgdef(name, ros_version=2)
            self._kinds[name] = MessageKind(name, "cdr", "ros2msg", text.encode())
        return self._kinds[name]

    def _channel(self, topic: str, kind: MessageKind, copy_of: int | None) -> int:
        if (topic, copy_of) not in self._channels:
            if kind not in self._schemas:
                known = bool(kind.name or kind.text)  # number 0 states that there is no schema
                self._schemas[kind] = self._writer.register_schema(kind.name, *kind[2:]) if known else 0
            latched = kind.name in _LATCHED_TYPES or topic.endswith("tf_static")
            offered = {"offered_qos_profiles": _LATCHED} if latched and kind.message_encoding == "cdr" else {}
            number = self._writer.register_channel(topic, kind.message_encoding, self._schemas[kind], offered)
            self._channels[topic, copy_of] = number, kind
        channel, have = self._channels[topic, copy_of]
        if have != kind:
            raise ValueError(f"topic {topic} has the type {have.name}, so {kind.name} cannot be written to it")
        return channel

    @contextmanager
    def _reporting(self) -> Iterator[None]:
        """Turn an OSError into UnwritableError, and close the unfinished log."""
        try:
            yield
        except OSError as error:
            with suppress(OSError):  # the unflushed rest is lost
                self._file.close()
            raise unwritable(self.path, error.strerror or str(error), self._kept()) from error

    def _kept(self) -> str:
        """A note about what stays of the unfinished log: with `keep`, one with messages."""
        held = 0
        if self._keep:
            with suppress(LogError), McapFile(self._partial) as log:
                held = log.count(set(log.channels))
        if not held:
            self._partial.unlink(missing_ok=True)
        return f" (its first {counted(held, 'message')} are in {self._partial})" if held else ""


def _messages_of(path: Path, topics: Iterable[str]) -> Iterator[tuple[Channel, RawMessage]]:
    """The whole messages of the first channel of each topic; none of a log that cannot be read."""
    with suppress(LogError), McapFile(path) as log:
        own = {min(log.channels_of([topic]), default=-1) for topic in topics}
        for item in log.messages(own):
            if isinstance(item, RawMessage):
                yield log.channels[item.channel], item


def kind_of(channel: Channel) -> MessageKind:
    """The type of a channel's messages."""
    schema = channel.schema
    if schema is None:
        return MessageKind("", channel.message_encoding, "", b"")
    return MessageKind(schema.name, channel.message_encoding, schema.encoding, schema.text)
