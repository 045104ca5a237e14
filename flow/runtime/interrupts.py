"""Interrupts: the first one finishes the frames in flight, the second one abandons them."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType


class Stop:
    """The requests to stop a run."""

    def __init__(self) -> None:
        self._requests = 0
        self.reading = False  # whether the log is being read, where an exception does no harm

    def request(self) -> None:
        """One more interrupt."""
        self._requests += 1

    def finishing(self) -> bool:
        """Whether no new frame may start."""
        return self._requests >= 1

    def abandoning(self) -> bool:
        """Whether nobody waits for the frames in flight either."""
        return self._requests >= 2


@contextmanager
def interrupts(stop: Stop, report: Callable[[str], None]) -> Iterator[None]:
    """Turn SIGINT, SIGTERM and SIGHUP into requests to `stop`, and pass a sentence about each to `report`.

    SIGHUP stays ignored where it is, as under nohup. The handlers from before are restored at the end.
    """

    def request(number: int, frame: FrameType | None) -> None:
        stop.request()
        abandoning = stop.abandoning()
        with suppress(Exception):  # the terminal may be gone; the run must still end properly
            report("abandoning the frames in flight" if abandoning else "interrupted: finishing the frames in flight")
        if abandoning and stop.reading:
            raise KeyboardInterrupt  # leaves a source that does not answer

    in_main = threading.current_thread() is threading.main_thread()  # Python delivers signals to this thread only
    signals = [signal.SIGINT, signal.SIGTERM] if in_main else []
    if in_main and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        signals.append(signal.SIGHUP)
    before = {number: signal.signal(number, request) for number in signals}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
