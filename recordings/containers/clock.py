"""Finds where the recorder's clock was set, by the log times in file order and the header stamps beside them.

A file may hold its messages in any order, so a log time that falls proves nothing. There are three cases:

- The header stamps went on while the log times fell. The recorder's clock alone was set back, and its log times are
  corrected.
- The stamps fell too, and the log times of a channel repeat: there are twice as many as its rate allows, or they
  interleave irregularly. All clocks were set back. Nothing separates the readings of the two passes, so those of the
  second one are lost.
- Otherwise the file is stored in another order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recordings.containers.timeline import Places, Timeline

MAX_JITTER_NS = 100_000_000  # messages of a channel may be logged out of order by this much
SETTLING_NS = 1_000_000_000  # after the clock was set back, messages are lost until it is this far beyond its old time
_MAX_STEPS = 8  # a clock is set rarely; more steps mean that the file is stored in another order
_BEFORE = 3  # messages of a channel before a step whose header stamps are read; of those after it, the first
_MAX_STAMPED = 3  # channels whose header stamps are read
_DENSE = 1.5  # times the rate of a channel: two passes of the clock, not one
_IRREGULAR = 0.1  # the intervals of two passes together spread more than those of each by at least this

StampAt = Callable[[int], int]  # place -> header stamp, ns; 0 if there is none


class ClockStep(NamedTuple):
    """A step of the recorder's clock.

    place: of the first message after it; shift: to add to log times from there on, ns; repeats_until: earlier log times
    are of the second pass, ns; fall: how far the clock was set back, ns.
    """

    place: int
    shift: int
    repeats_until: int
    fall: int


def clock_steps(timeline: Timeline, stamped: set[int], stamp_at: StampAt) -> list[ClockStep]:
    """The steps of the recorder's clock, in file order. stamped: channels whose messages begin with a header."""
    falls = _jumps(timeline, lambda gaps: gaps < -MAX_JITTER_NS)
    steps = _judged(timeline, falls, stamped, stamp_at)
    if shifts := [step.shift for step in steps if step.shift]:  # the clock may have been set right again
        jumps = _jumps(timeline, lambda gaps: (gaps < -MAX_JITTER_NS) | (gaps > min(shifts) // 2))
        steps = _judged(timeline, jumps, stamped, stamp_at) or steps
    return steps


def _jumps(timeline: Timeline, is_jump: Callable[[NDArray[np.int64]], NDArray[np.bool_]]) -> list[tuple[int, int]]:
    """(Place, change of the log time in ns) of each step that some channels show; empty if there are too many."""
    found = list[tuple[int, int, int]]()
    for places in timeline.by_channel.values():
        gaps = np.diff(timeline.log_times[places])
        at = np.flatnonzero(is_jump(gaps))[: _MAX_STEPS + 1]
        found += zip(places[at + 1].tolist(), places[at].tolist(), gaps[at].tolist(), strict=True)
    steps = list[tuple[int, int]]()
    for place, before, gap in sorted(found):
        if not steps or before >= steps[-1][0]:  # otherwise the channel shows the step before
            steps.append((place, gap))
    return steps if len(steps) <= _MAX_STEPS else []


def _judged(timeline: Timeline, jumps: list[tuple[int, int]], stamped: set[int], stamp_at: StampAt) -> list[ClockStep]:
    steps, shift, repeats_until = list[ClockStep](), 0, 0
    for number, (place, gap) in enumerate(jumps):
        stop = jumps[number + 1][0] if number + 1 < len(jumps) else len(timeline)
        since = jumps[number - 1][0] if number else 0
        change = _offset_change(timeline, since, place, stamped, stamp_at)
        if change is not None and change * gap > 0 and abs(change) > max(MAX_JITTER_NS, abs(gap) // 2):
            shift = 0 if abs(shift - change) < MAX_JITTER_NS else shift - change
        elif gap < 0 and _repeats(timeline, place, stop):
            repeats_until = max(repeats_until, int(np.max(timeline.log_times[:place])) + SETTLING_NS)
        else:
            continue
        steps.append(ClockStep(place, shift, repeats_until, -gap))
    return steps


def _offset_change(timeline: Timeline, since: int, place: int, stamped: set[int], stamp_at: StampAt) -> int | None:
    """How much log times gained on the header stamps at a place, ns; None if there are no stamps.

    since: the place of the step before.
    """
    changes, nearest = list[float](), list[tuple[int, Places, Places]]()
    for channel in stamped & timeline.by_channel.keys():
        places = timeline.by_channel[channel]
        first, at = np.searchsorted(places, [since, place]).tolist()
        before, after = places[max(at - _BEFORE, first) : at], places[at : at + 1]
        if len(before) and len(after):
            nearest.append((int(after[0] - before[-1]), before, after))
    for _, before, after in sorted(nearest, key=lambda sides: sides[0])[:_MAX_STAMPED]:
        offsets = [list(_offsets(timeline, side, stamp_at)) for side in (before, after)]
        if all(offsets):
            changes.append(float(np.median(offsets[1]) - np.median(offsets[0])))
    return round(float(np.median(changes))) if changes else None


def _offsets(timeline: Timeline, places: Places, stamp_at: StampAt) -> Iterator[int]:
    for place in places.tolist():
        if stamp := stamp_at(place):
            yield int(timeline.log_times[place]) - stamp


def _repeats(timeline: Timeline, place: int, stop: int) -> bool:
    """Whether the log times from `place` to `stop` are a second pass over times before."""
    density, spreads = list[float](), list[float]()
    for places in timeline.by_channel.values():
        all_times = timeline.log_times[places]
        first, last = np.searchsorted(places, [place, stop])
        old, new = all_times[:first], all_times[first:last]
        if not len(old) or not len(new):
            continue
        low = int(np.min(new))
        high = max(min(int(np.max(new)), int(np.max(old))), low)
        spread = max(_spread(_around(times, low, high)) for times in (old, new))
        inside = [(times >= low) & (times <= high) for times in (old, new)]
        counts = [int(np.count_nonzero(part)) for part in inside]
        merged = _distinct(np.concatenate([times[part] for times, part in zip((old, new), inside, strict=True)]))
        recorded_twice = len(merged) <= 0.75 * sum(counts)
        if not counts[0] or counts[1] < 2 or recorded_twice:
            continue
        spreads.append(_spread(merged) - spread)
        interval = float(np.median(np.diff(_distinct(all_times)), overwrite_input=True))
        density.append((len(merged) - 1) * interval / (high - low))
    return bool(density) and bool(np.median(density) > _DENSE or np.median(spreads) > _IRREGULAR)


def _distinct(times: NDArray[np.int64]) -> NDArray[np.int64]:
    """The sorted unique times, which are sorted in place; `np.unique` takes seconds for millions that differ."""
    times.sort()
    kept = np.append(True, times[1:] != times[:-1])
    return times if kept.all() else times[kept]


def _around(times: NDArray[np.int64], low: int, high: int) -> NDArray[np.int64]:
    """The times from `low` to `high`, with one more on either side."""
    times = np.sort(times)
    first, last = np.searchsorted(times, [low, high])
    return times[max(first - 1, 0) : last + 1]


def _spread(times: NDArray[np.int64]) -> float:
    """The standard deviation of the intervals of sorted times in parts of their mean."""
    gaps = np.diff(times).astype(float)
    return float(gaps.std() / gaps.mean()) if len(gaps) > 1 and gaps.mean() > 0 else 0.0


def corrected(timeline: Timeline, steps: list[ClockStep]) -> tuple[Timeline, NDArray[np.bool_]]:
    """The timeline with corrected log times, and which of its messages have times that repeat."""
    repeated = np.zeros(len(timeline), bool)
    if not steps:
        return timeline, repeated
    times = timeline.log_times.copy()
    for step, end in zip(steps, [*(step.place for step in steps[1:]), len(timeline)], strict=True):
        part = times[step.place : end]
        repeated[step.place : end] = (part >= 0) & (part < step.repeats_until)
        part[part >= 0] += step.shift
    return Timeline(timeline.channels, times), repeated
