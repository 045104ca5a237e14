"""Writes ROS 2 messages into an MCAP log that has its name only when it is whole.

Its one trick: a large message is a chunk of its own, so whoever wants only the small topics (tilt, calibration,
transforms) decompresses no images.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from flow.contracts import counted
from recordings.atomic_write import give_name, temporary_name, unwritable, writing
from recordings.errors import LogError
from recordings.mcap.file import McapFile
from recordings.ros2.cdr import LAST_STAMP, TYPES

LARGE = 64 * 1024  # bytes; from here a message gets a chunk of its own
COMPRESSIONS = {"lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD, "none": CompressionType.NONE}


class Ros2Writer:
    """Writes messages as `ros2msg` / CDR, log time = publish time = stamp. Same calls, same bytes.

    Use as a context manager: leaving it closes the log, leaving it by an exception discards it. keep: if the place is
    full, or fails otherwise, keep under another name what it holds by then. compression: lz4, zstd or none.
    """

    def __init__(self, path: Path, keep: bool = False, compression: str = "zstd") -> None:
        self.path, self._keep = Path(path), keep
        self._partial = temporary_name(self.path)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, tuple[int, str]] = {}
        self._counts: dict[str, int] = {}
        with writing(self.path):
            self._file = self._partial.open("wb")
        self._writer: Any = Writer(self._file, chunk_size=1024 * 1024, compression=COMPRESSIONS[compression])
        self._writer.start(profile="ros2", library="roverflow")

    @property
    def closed(self) -> bool:
        """Whether the log is finished, or discarded."""
        return self._file.closed

    def write(self, topic: str, message: Any, stamp: int) -> None:
        """Append one message; the topic's channel is registered by its first message and keeps that type."""
        kind = message.__msgtype__
        if not 0 <= stamp < LAST_STAMP:
            raise ValueError(f"{kind} for {topic}: a stamp of {stamp} ns cannot be written; give ns since 1970")
        data = TYPES.serialize_cdr(message, kind)
        try:
            channel = self._channel(topic, kind)
            count = self._counts[topic] = self._counts.get(topic, 0) + 1
            large = len(data) >= LARGE
            if large:
                self._writer.flush()
            self._writer.add_message(channel, log_time=stamp, publish_time=stamp, data=data, sequence=count)
            if large:
                self._writer.flush()
        except OSError as error:
            raise self._unwritable(error) from error

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Append one metadata record, its keys in sorted order."""
        try:
            self._writer.flush()
            self._writer.add_metadata(name, dict(sorted(values.items())))
        except OSError as error:
            raise self._unwritable(error) from error

    def close(self) -> None:
        """Finish the log and give it its name. Closing twice does nothing."""
        if self._file.closed:
            return
        try:
            self._writer.finish()
            self._file.close()
            give_name(self._partial, self.path)
        except OSError as error:
            raise self._unwritable(error) from error

    def abort(self) -> None:
        """Discard what was written so far; a log that was at `path` before stays. After `close`, does nothing."""
        if self._file.closed:
            return
        with suppress(OSError):  # what could not be flushed is being discarded
            self._file.close()
        self._partial.unlink(missing_ok=True)

    def __enter__(self) -> Ros2Writer:
        return self

    def __exit__(self, kind: object, *raised: object) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()

    def _channel(self, topic: str, kind: str) -> int:
        if topic not in self._channels:
            if kind not in self._schemas:
                text, _ = TYPES.generate_msgdef(kind, ros_version=2)
                self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", text.encode())
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[kind]), kind
        channel, have = self._channels[topic]
        if have != kind:
            raise ValueError(f"topic {topic} holds {have}, so {kind} cannot be written to it")
        return channel

    def _unwritable(self, error: OSError) -> LogError:
        """Close what is half there, keep it if it shall be and holds anything, and say so."""
        held = 0
        with suppress(OSError):  # what could not be flushed is lost
            self._file.close()
        if self._keep:
            with suppress(LogError), McapFile(self._partial) as log:
                held = log.count(set(log.index.channels))
        if not held:
            self._partial.unlink(missing_ok=True)
        kept = f" (the {counted(held, 'message')} that it took are in {self._partial})" if held else ""
        return unwritable(self.path, error.strerror or str(error), kept)
