"""The ledger: every message or frame that did not make it, with stream, stamp, stage and reason.

Nothing is ever dropped without an entry here. A run is COMPLETE when there is none, its log was read to the end and its
outputs are whole.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from opcode import opmap
from pathlib import Path
from types import TracebackType

from flow.contracts import Loss

log = logging.getLogger(__name__)
_HOUSE = {"flow", "stages", "recordings"}


FLOW = Path(__file__).resolve().parent.parent


def failure(error: BaseException) -> str:
    """What the ledger says of an exception: a ValueError that a stage chose to raise speaks for itself, others need
    their name and place."""
    log.debug("%s", error, exc_info=error)
    calls = _calls(error)
    if isinstance(error, ValueError) and (not calls or _chosen(calls)):
        return str(error)
    own = [call for call in calls if _file(call) == _file(calls[0])]
    place = f" ({_file(own[-1]).name}, line {own[-1].tb_lineno}; --debug shows the way there)" if own else ""
    return f"{type(error).__name__}: {error}{place}"


def _calls(error: BaseException) -> list[TracebackType]:
    """The way from the stage that was called to where an exception came up; empty where none had been called."""
    calls, call = list[TracebackType](), error.__traceback__
    while call is not None:
        if FLOW not in _file(call).parents and not _file(call).name.startswith("<"):
            calls.append(call)
        call = call.tb_next
    return calls


def _chosen(calls: list[TracebackType]) -> bool:
    """Whether a `raise` of the stage's own package or of this house ends the way: not an operation that failed, nor a
    library, neither of which can know what to do about it."""
    last = calls[-1]
    raised = last.tb_frame.f_code.co_code[last.tb_lasti] == opmap["RAISE_VARARGS"]
    return raised and _package(last) in {*_HOUSE, _package(calls[0])}


def _file(call: TracebackType) -> Path:
    return Path(call.tb_frame.f_code.co_filename)


def _package(call: TracebackType) -> str:
    return str(call.tb_frame.f_globals.get("__name__")).partition(".")[0]


class Ledger:
    """The entries of one run, in the order they were made; safe to share between threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._entries: list[Loss] = []

    def add(self, entry: Loss) -> Loss:
        """Record a loss."""
        with self._lock:
            self._entries.append(entry)
        return entry

    @property
    def entries(self) -> tuple[Loss, ...]:
        """All entries, sorted by stamp, stage and stream, so that equal runs give equal ledgers."""
        with self._lock:
            return tuple(sorted(self._entries, key=lambda entry: (entry.stamp, entry.stage, entry.stream)))

    def counts(self) -> dict[str, int]:
        """Number of entries by reason."""
        return dict(sorted(Counter(str(entry.reason) for entry in self.entries).items()))

    def __len__(self) -> int:
        return len(self._entries)
