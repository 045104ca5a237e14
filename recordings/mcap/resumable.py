"""Writes a log that an interruption leaves unfinished, and copies from such a log what takes long to make.

The mark in the name of an unfinished log stands for what these messages are made from. All others are made again.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, suppress
from itertools import groupby
from operator import attrgetter
from os.path import samestat
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from recordings.atomic_write import temporary_name, writing
from recordings.containers.container import Channel, RawMessage
from recordings.errors import LogError, UnwritableError
from recordings.mcap.file import McapFile
from recordings.mcap.writer import Ros2Writer


class ResumableWriter(Ros2Writer):
    """A `Ros2Writer` whose unfinished log stays after an interrupt, a full disk or a kill.

    mark: states what the messages are made from that `skip` copies. contained: the stamps, ns, in the unfinished log of
    this mark, by topic; others: unfinished logs of other marks. Raises UnwritableError if the log cannot be written, or
    another writer of the same mark is at work.
    """

    def __init__(self, path: Path, mark: str) -> None:
        self._mark, self._opened = mark, ExitStack()
        super().__init__(path)
        with writing(self.path):
            self.others = [name for name in self._unfinished() if f".import-{mark}." not in name.name]
        self.contained: Mapping[str, set[int]] = {}
        self._channels_before: Mapping[int, Channel] = {}
        self._groups: Iterator[tuple[int, Iterator[Any]]] = iter(())
        self._stamp, self._copies = -1, dict[str, RawMessage]()
        with suppress(LogError):
            log = self._opened.enter_context(McapFile(self._before))
            topics = {channel.topic: log.channels_of([channel.topic]) for channel in log.channels.values()}
            self.contained = {topic: set(log.times(channels).tolist()) for topic, channels in topics.items()}
            self._channels_before = log.channels
            whole = [place for chunk in log.index.chunks if not chunk.is_cut for place in chunk.places]
            places = log.timeline.chosen(set(log.channels), None, None)
            places = places[np.isin(places, whole)]  # a CRC covers each
            self._groups = groupby(log.read(places), attrgetter("log_time"))

    def skip(self, topic: str, stamp: int) -> bool:
        """Copy a message of the unfinished log; False if it is not there. The stamps must ascend."""
        while self._stamp < stamp:
            self._stamp, group = next(self._groups, (1 << 64, iter(())))
            whole = [item for item in group if isinstance(item, RawMessage)]
            self._copies = {self._channels_before[item.channel].topic: item for item in whole}
        if self._stamp > stamp or topic not in self._copies:
            return False
        copy = self._copies[topic]
        schema = self._channels_before[copy.channel].schema
        assert schema is not None
        self.add(topic, self._kind(schema.name), stamp, copy.data)
        return True

    def close(self) -> None:
        """Finish the log and give it its name; unfinished logs are removed."""
        if self.closed:
            return
        super().close()
        for name in self._unfinished():
            with suppress(OSError), name.open("rb") as file:  # another writer has locked its own
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                name.unlink()

    def __exit__(self, kind: Any, *raised: object) -> None:
        self._opened.close()
        if kind is not None and issubclass(kind, KeyboardInterrupt) and self._counts:
            with suppress(OSError):  # messages that are not in a chunk are made again
                self._file.close()
        super().__exit__(kind, *raised)

    def _temporary_name(self) -> Path:
        return temporary_name(self.path, f"import-{self._mark}")

    @property
    def _before(self) -> Path:
        """The unfinished log that is copied from: of those of several interruptions the largest one."""
        return self._partial.with_suffix(".before")

    def _unfinished(self) -> list[Path]:
        """All unfinished logs."""
        names = (name for name in self.path.parent.iterdir() if name.name.startswith(f"{self.path.name}.import-"))
        return [name for name in names if name.suffix in (".partial", ".before")]

    def _open(self) -> BinaryIO:
        file = self._locked()
        size = os.fstat(file.fileno()).st_size
        if size and size >= (self._before.stat().st_size if self._before.exists() else 0):
            self._partial.replace(self._before)
            file.close()
            file = self._locked()
        file.seek(file.truncate(0))
        return file

    def _locked(self) -> BinaryIO:
        """The unfinished log of the same mark, or a new file."""
        file = self._partial.open("ab")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            free = samestat(self._partial.stat(), os.fstat(file.fileno()))
        except (BlockingIOError, FileNotFoundError):  # another import writes it, or has just finished it
            free = False
        except OSError:  # the file system has no locks
            free = True
        if not free:
            file.close()
            raise UnwritableError(f"{self.path} is being written by another import; wait for it, or stop it")
        return file

    def _kept(self) -> str:
        return f" (what was written is in {self._partial}, and the same command continues it)"
