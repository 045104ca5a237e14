"""The ledger: every message or frame that did not make it, with stream, stamp, stage and reason.

Nothing is ever dropped without an entry here. A run is COMPLETE when there is none, its log was read to the end and its
outputs are whole.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from pathlib import Path
from traceback import extract_tb

from flow.contracts import Loss, StageError

log = logging.getLogger(__name__)
FLOW = Path(__file__).resolve().parent.parent


def failure(error: BaseException) -> str:
    """The ledger's sentence about an exception: a StageError as it is, any other with its type, file and line."""
    log.debug("%s", error, exc_info=error)
    if isinstance(error, StageError):
        return str(error)
    calls = [call for call in extract_tb(error.__traceback__) if not call.filename.startswith("<")]
    outside = [call for call in calls if FLOW not in Path(call.filename).parents]
    # The last line in the file of the stage itself: what its libraries do further down means little to a user.
    own = [call for call in outside if call.filename == outside[0].filename]
    where = f" ({Path(own[-1].filename).name}, line {own[-1].lineno}; --debug shows the traceback)" if own else ""
    return f"{type(error).__name__}: {error}{where}"


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
