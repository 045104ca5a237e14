"""Which messages belong to a part of a log, as --start and --end select it.

Stamps decide, so that both images of a frame are inside or outside: a right image goes with the left one of its frame.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

MAX_LATENESS_NS = 3_000_000_000  # between a message's stamp and its log time; beyond, the stamps are of another clock
EDGE_NS = 1_000_000_000  # images are logged so soon after their stamps that this far beyond an edge its frame is found
_MAX_PAIR_NS = 50_000_000  # the stamps of the two images of a frame differ by less


@dataclass(frozen=True)
class TimeRange:
    """The part of a log from `low` to before `high`, ns; None for an open end."""

    low: int | None = None
    high: int | None = None

    @classmethod
    def after(cls, first: int, start: float | None, end: float | None) -> TimeRange:
        """The part from `start` to `end`, s after the first message at `first`, ns."""
        low = first + round(start * 1e9) if start else None  # the stamps of the first messages are before `first`
        return cls(low, None if end is None else first + round(end * 1e9))

    @property
    def edges(self) -> list[int]:
        """Its ends that are not open, ns."""
        return [edge for edge in (self.low, self.high) if edge is not None]

    def has(self, stamp: int, log_time: int) -> bool:
        """Whether a message is inside: by its stamp, if that is of the log's clock, else by its log time."""
        when = stamp if stamp and abs(stamp - log_time) < MAX_LATENESS_NS else log_time
        return (self.low is None or when >= self.low) and (self.high is None or when < self.high)

    def widened(self, by: int, before: int | None = None) -> TimeRange:
        """The range with `by` ns more at both ends, or `before` ns more at its beginning."""
        low = None if self.low is None else max(self.low - (by if before is None else before), 0)
        return TimeRange(low, None if self.high is None else self.high + by)


class FramesInRange:
    """The images of a part of a log. lefts: (stamp, log time) of left images around its edges, ns."""

    def __init__(self, part: TimeRange, lefts: Iterable[tuple[int, int]]) -> None:
        self.part = part
        self._lefts = [(stamp or log_time, part.has(stamp, log_time)) for stamp, log_time in lefts]

    def has(self, side: str, stamp: int, log_time: int) -> bool:
        """Whether an image of a side is inside."""
        when = stamp or log_time
        if side == "right" and any(abs(when - edge) < _MAX_PAIR_NS for edge in self.part.edges):
            apart, inside = min(
                ((abs(left - when), inside) for left, inside in self._lefts), default=(_MAX_PAIR_NS, True)
            )
            if apart < _MAX_PAIR_NS:
                return inside
        return self.part.has(stamp, log_time)
