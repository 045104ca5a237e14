"""How noisy an inclinometer is: each reading compared with the line through its two neighbours.

A reading is off the line by noise, vibration, jitter of the stamps, or because the tilt changes faster than its rate
shows. All of them are errors of a tilt between two readings.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

from stages.data import Tilt

WINDOW = 40  # readings
MIN_READINGS = 8
MAX_STEP_RATIO = 3.0  # of the times to the two neighbours; beyond it there is a gap
KEPT_SHARE = 0.9  # of the squared residuals, the smallest; a single wrong reading is in three of them
KEPT_MEAN = 0.744  # mean of those of an exponential distribution of mean 1, which noise about two axes has


@dataclass
class TiltNoise:
    """The last readings of one stream."""

    last: deque[Tilt] = field(default_factory=lambda: deque(maxlen=3))
    squares: deque[float] = field(default_factory=lambda: deque(maxlen=WINDOW))  # rad^2, of both axes

    def __call__(self, tilt: Tilt) -> Tilt:
        """The reading with the larger of two sigmas: the one that it has, and the one that the last readings show."""
        if self.last and tilt.stamp <= self.last[-1].stamp:
            return tilt
        self.last.append(tilt)
        self._compare()
        if len(self.squares) < MIN_READINGS - 2:
            return tilt
        kept = sorted(self.squares)[: max(int(KEPT_SHARE * len(self.squares)), 1)]
        shown = math.sqrt(sum(kept) / len(kept) / KEPT_MEAN / 2)
        return tilt.with_sigma(max(shown, tilt.sigma or 0.0))

    def _compare(self) -> None:
        """Add the residual of the last reading but one."""
        if len(self.last) < 3:
            return
        before, at, after = self.last
        steps = at.stamp - before.stamp, after.stamp - at.stamp
        if max(steps) > MAX_STEP_RATIO * min(steps):
            return
        share = steps[0] / (steps[0] + steps[1])
        off = at.up - (1 - share) * before.up - share * after.up
        self.squares.append(float(off @ off) / (1 + share**2 + (1 - share) ** 2))
