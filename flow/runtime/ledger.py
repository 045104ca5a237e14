"""The ledger: an entry for every lost message and frame, with stream, stamp, stage and reason.

Nothing is dropped without an entry. A run is COMPLETE if there is none, there was a frame, no stage found a fault, its
log was read to the end and all outputs were written.
"""

from __future__ import annotations

import logging
from collections import Counter
from pathlib import Path
from traceback import extract_tb

from flow.contracts import Loss, StageError

log = logging.getLogger(__name__)
FLOW = Path(__file__).resolve().parent.parent


def failure(error: BaseException) -> str:
    """The ledger's sentence about an exception: a StageError as it is, any other with its type, file and line."""
    try:
        text = " ".join(str(error).split())
    except Exception:  # of the exception's own class
        text = "its message cannot be read"
    log.debug("%s", text, exc_info=error)
    if isinstance(error, StageError):
        return text
    calls = [call for call in extract_tb(error.__traceback__) if not call.filename.startswith("<")]
    outside = [call for call in calls if FLOW not in Path(call.filename).parents]
    # The last line in the file of the stage itself: what its libraries do further down means little to a user.
    own = [call for call in outside if call.filename == outside[0].filename]
    where = f" ({Path(own[-1].filename).name}, line {own[-1].lineno}; --debug shows the traceback)" if own else ""
    return f"{type(error).__name__}: {text}{where}"


class Ledger:
    """The losses of one run. Threads may share it."""

    def __init__(self) -> None:
        self._entries: list[Loss] = []

    def add(self, entry: Loss) -> Loss:
        """Enter a loss, and return it."""
        self._entries.append(entry)
        return entry

    @property
    def entries(self) -> tuple[Loss, ...]:
        """All entries, by stamp, stage and stream, so that equal runs have equal ledgers."""
        return tuple(sorted(self._entries, key=lambda entry: (entry.stamp, entry.stage, entry.stream)))

    def counts(self) -> dict[str, int]:
        """Number of entries by reason."""
        return dict(sorted(Counter(str(entry.reason) for entry in self.entries).items()))

    def __len__(self) -> int:
        return len(self._entries)
