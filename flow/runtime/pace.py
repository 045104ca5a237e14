"""The pace of a run: as fast as it can, or as on the vehicle, where frames come whether or not a worker is free."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

STEP = 0.1  # s, between looks at a request to stop


class Pace:
    """When frames are due. rate: times as fast as their stamps, None for as fast as possible.

    due: of the frame that was waited for, s of `time.perf_counter`, None without a rate; deadline: when the next one is
    due, by the last interval.
    """

    def __init__(self, rate: float | None) -> None:
        self.due: float | None = None
        self.deadline = math.inf
        self._rate, self._last = rate, 0

    def wait(self, stamp: int, stop: Callable[[], bool]) -> None:
        """Wait until the frame of a stamp, ns, is due, or until `stop()` is true. The first frame is due at once."""
        if self._rate is None:
            return
        if self.due is None:
            self.due = time.perf_counter()
        else:
            interval = (stamp - self._last) / 1e9 / self._rate
            self.due += interval
            self.deadline = self.due + interval
        self._last = stamp
        while (left := self.due - time.perf_counter()) > 0 and not stop():
            time.sleep(min(left, STEP))
