"""The ledger: every message or frame that did not make it, with stream, stamp, stage and reason.

A run is COMPLETE when the ledger is empty. Nothing is ever dropped without an entry here.
"""

from __future__ import annotations

import threading
from collections import Counter
from dataclasses import asdict, dataclass
from enum import StrEnum


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
    """What the ledger says of an exception: a ValueError speaks for itself, others need their name."""
    return str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"


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
