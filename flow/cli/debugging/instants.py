"""Instants of a log: the frames at a time or a stamp, and whether a log has those of a run."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flow.cli.arguments import MAX_SECONDS
from flow.errors import UsageError
from recordings.containers.container import RawMessage
from recordings.containers.time_range import MAX_LATENESS_NS

if TYPE_CHECKING:
    from recordings.source.log import McapLog

DAY = 86_400_000_000_000  # ns
MARGIN = 1_000_000_000  # ns before the first and after the last image of a log
ROUNDING = 100_000_000  # ns, of an instant as a user gives it
Instant = float | np.datetime64 | np.timedelta64


@dataclass(frozen=True)
class Part:
    """The frames of an instant, and those before it. Times are in s after the log's first message.

    start, end: the part to read; first: where it would begin without the frames before the instant; at, stamp: the
    stamp of the first frame of the instant, in s and in ns; frames, before: numbers of left images from the instant on
    and before it.
    """

    start: float
    end: float
    at: float
    frames: int
    before: int
    stamp: int
    first: float


class FrameLoss(NamedTuple):
    """A loss of a frame. detail: one sentence, empty if unknown."""

    stream: str
    reason: str
    detail: str

    @property
    def words(self) -> str:
        """The loss in words."""
        return f"{self.stream} {self.reason}" + (f": {self.detail}" if self.detail else "")


def part_of(log: McapLog, at: Instant, frames: int, before: int | np.datetime64) -> Part:
    """The left images nearest to an instant, and those before them; raises UsageError for one outside the images.

    at: s after the log's first message; or a stamp; or the time of the day, UTC, of one; before: their number, or the
    stamp of the first of them.
    """
    times = log.file.times(log.channels("left")) if "left" in log.topics else np.zeros(0, np.int64)
    if not times.size:
        raise UsageError(f"{log.path} has no left images")
    chosen = chosen_frame(log, times, at)
    earlier = chosen - _nearest(log, times, before) if isinstance(before, np.datetime64) else before
    low, end = max(0, chosen - earlier), min(times.size, chosen + frames)
    stamp = _stamp(log, times, chosen)
    delay = int(times[chosen]) - stamp
    # The log is cut by stamps, unless these are of another clock.
    edges, numbers = edges_of(log, times - delay * (abs(delay) < MAX_LATENESS_NS)), (end - chosen, chosen - low)
    return Part(edges[low], edges[end], (stamp - log.first_stamp) / 1e9, *numbers, stamp, edges[chosen])


def chosen_frame(log: McapLog, times: NDArray[np.int64], at: Instant) -> int:
    """The place of the left image at an instant; raises UsageError for one outside the images. times: log times, ns."""
    chosen = _nearest(log, times, at)
    off = ns_of(at, log.first_stamp) - _stamp(log, times, chosen)
    if (chosen == 0 and off < -ROUNDING) or (chosen == times.size - 1 and off > ROUNDING):
        raise UsageError(_outside(log, times, at))
    return chosen


def edges_of(log: McapLog, times: NDArray[np.int64]) -> list[float]:
    """Where the part of a log begins that contains each left image, and where the last part ends, s."""
    edges = np.concatenate([times[:1] - MARGIN, (times[1:] + times[:-1]) // 2, times[-1:] + MARGIN])
    return [(edge - log.begin) / 1e9 for edge in edges.tolist()]  # stamps may precede the log's first message


def no_frame(part: Part, loss: FrameLoss | None, log: McapLog, pipeline: str | Path = "rover") -> UsageError:
    """The error for a part whose run gave no frame. loss: at its stamp; pipeline: as for `run_from`."""
    why = "" if loss is None else f": {loss.words}"
    remedy = "" if loss is not None and loss.detail else f"; {run_from(log, part, pipeline=pipeline)} says why"
    return UsageError(f"no frame was completed at {part.at:.3f} s{why}{remedy}")


def run_from(log: McapLog, part: Part, end: float | None = None, *, pipeline: str | Path) -> str:
    """The command that runs a log from the instant on.

    end: s after the log's first message; pipeline: its name or file; a path is that of a result log, which `run` does
    not take.
    """
    files = [log.given] if isinstance(log.given, Path | str) else log.given
    until = "" if end is None else f" --end {end:.3f}"
    named = [] if isinstance(pipeline, Path) or pipeline == "rover" else ["-p", pipeline]
    what = shlex.join([*map(str, files), *named])
    return f"roverflow run {what} --start {max(0, part.first):.3f}{until} -o OTHER.mcap"


def _outside(log: McapLog, times: NDArray[np.int64], at: Instant) -> str:
    """The sentence that an instant is outside the images of a log. times: their log times, ns."""
    ends = _stamp(log, times, 0), _stamp(log, times, -1)
    if isinstance(at, float | int):
        first, last = ((stamp - log.first_stamp) / 1e9 for stamp in ends)
        return f"--at {at:.12g} is outside the images of the log, which lie from {first:.3f} to {last:.3f} s"
    given, begin, end = map(_shown, (ns_of(at, log.first_stamp), *ends))
    return f"--at {given} is outside the images of the log, which lie from {begin} to {end}"


def _shown(stamp: int) -> str:
    """A stamp, ns, as `--at` takes it, and in ns."""
    return f"{np.datetime64(stamp // 1_000_000, 'ms')}Z ({stamp} ns)"


def is_other(log: McapLog, stamps: NDArray[np.int64]) -> bool:
    """Whether a log has left images, but none of those of a run, whose sorted stamps, ns, are given."""
    times = log.file.times(log.channels("left")) if "left" in log.topics else np.zeros(0, np.int64)
    if not (times.size and stamps.size):
        return False
    tried = stamps[[0, stamps.size // 2, -1]].astype("datetime64[ns]")
    found = (_stamps(log, times, _nearest(log, times, stamp)).values() for stamp in tried)
    return not any(np.isin(list(near), stamps).any() for near in found)


def ns_of(at: Instant, begin: int) -> int:
    """The stamp of an instant in a log that begins at the stamp `begin`, ns. Raises UsageError for what is none."""
    if isinstance(at, float | int) and abs(at) < MAX_SECONDS:
        return begin + round(at * 1e9)
    if not isinstance(at, np.datetime64 | np.timedelta64):
        what = "seconds after the log's first message, a numpy.datetime64 or a numpy.timedelta64"
        raise UsageError(f"an instant must be {what}, not {at!r}")
    value = int(at.astype(f"{at.dtype.kind}8[ns]").astype(np.int64))
    if isinstance(at, np.timedelta64):  # of the first day on which the log has it
        start = begin - MARGIN
        value = start + (value - start) % DAY
    return value


def _nearest(log: McapLog, times: NDArray[np.int64], at: Instant) -> int:
    """The place of the left image nearest to an instant. times: log times, ns."""
    when = ns_of(at, log.first_stamp)
    delay = sum(time - stamp for time, stamp in _stamps(log, times, 0, 0).items())
    chosen = int(np.argmin(np.abs(times - when - delay)))
    near = _stamps(log, times, chosen)
    return int(np.searchsorted(times, min(near, key=lambda time: abs(near[time] - when), default=times[chosen])))


def _stamp(log: McapLog, times: NDArray[np.int64], place: int) -> int:
    """The stamp, ns, of the left image at a place."""
    time = int(times[place])
    return _stamps(log, times, place % times.size, reach=0).get(time, time)


def _stamps(log: McapLog, times: NDArray[np.int64], place: int, reach: int = 2) -> dict[int, int]:
    """Log time -> stamp, ns, of the left image at a place and of those within `reach` of it."""
    first, last = times[max(0, place - reach)], times[min(place + reach, times.size - 1)]
    raws = (raw for raw in log.file.messages(log.channels("left"), first, last + 1) if isinstance(raw, RawMessage))
    return {raw.log_time: log.stamp_of(raw, "left") for raw in raws}
