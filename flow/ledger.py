"""The ledger: every message or frame that did not make it, with stream, stamp, stage and reason.

A run is COMPLETE when the ledger is empty. Nothing is ever dropped without an entry here.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from traceback import extract_tb

log = logging.getLogger(__name__)


class Reason(StrEnum):
    """Why something was lost."""

    UNREADABLE = "unreadable"  # the source could not read or decode it
    OUT_OF_ORDER = "out of order"  # its stamp does not follow the one before it
    UNMATCHED = "unmatched"  # no partner for a pair
    UNALIGNED = "unaligned"  # another clock's stream had nothing for the frame
    FAILED = "failed"  # a stage raised
    ABANDONED = "abandoned"  # the run was stopped before the frame was through


class Verdict(StrEnum):
    """How a run ended."""

    COMPLETE = "COMPLETE"
    INCOMPLETE = "INCOMPLETE"


@dataclass(frozen=True)
class Entry:
    """One loss. stamp: ns of the log's clock; stage: the node that noticed; detail: one sentence."""

    stream: str
    stamp: int
    stage: str
    reason: Reason
    detail: str

    def as_dict(self) -> dict[str, str | int]:
        """The entry as plain JSON values."""
        return {**asdict(self), "reason": str(self.reason)}


@dataclass(frozen=True)
class Absent:
    """Stands in a frame for the item that was lost, so that nobody downstream waits for it."""

    cause: Entry


def failure(error: BaseException) -> str:
    """What the ledger says of an exception: a ValueError speaks for itself, others need their name and place."""
    log.debug("%s", error, exc_info=error)
    if isinstance(error, ValueError):
        return str(error)
    place = _place(error)
    return f"{type(error).__name__}: {error}{f' ({place}; --debug shows the way there)' if place else ''}"


def _place(error: BaseException) -> str:
    """Where in the file of the stage that was called an exception came up; empty where none had been called."""
    trace = [call for call in extract_tb(error.__traceback__) if not call.filename.startswith("<")]
    calls = [call for call in trace if Path(call.filename).parent != Path(__file__).parent]
    own = [call for call in calls if call.filename == calls[0].filename]
    return f"{Path(own[-1].filename).name}, line {own[-1].lineno}" if own else ""


class Ledger:
    """The entries of one run, in the order they were made; safe to share between threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._entries: list[Entry] = []

    def add(self, entry: Entry) -> Entry:
        """Record a loss."""
        with self._lock:
            self._entries.append(entry)
        return entry

    @property
    def entries(self) -> tuple[Entry, ...]:
        """All entries, sorted by stamp, stage and stream, so that equal runs give equal ledgers."""
        with self._lock:
            return tuple(sorted(self._entries, key=lambda entry: (entry.stamp, entry.stage, entry.stream)))

    def counts(self) -> dict[str, int]:
        """Number of entries by reason."""
        return dict(sorted(Counter(str(entry.reason) for entry in self.entries).items()))

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def verdict(self) -> Verdict:
        """COMPLETE if nothing was lost."""
        return Verdict.INCOMPLETE if self._entries else Verdict.COMPLETE
