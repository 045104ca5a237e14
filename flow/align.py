"""Alignment: joins streams that run on different clocks, with a limit on how long to wait for a partner.

An aligner is configuration; `start` makes its state for one run, a small state machine that gets messages in the order
of log time. It answers with one token for each stamp of the clock that it aligns to: the joined item, or `Absent` with
the ledger's entry about the reason. The answers depend on the order of the log only, so every replay gives the same.

A waiting message gives up when the stream of its partner has moved past it, or when the log's clock has moved on by
`patience` since it arrived, whichever comes first. So an aligner knows when no partner will come (its watermark).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import median_low
from typing import Any

from flow.contracts import Absent, Loss, LossReason
from flow.parameters import Checked, parameter
from flow.runtime.graph import hints_of
from flow.runtime.ledger import failure

__all__ = ["interpolate", "latest", "nearest", "pair"]  # as pipeline files name them


@dataclass(frozen=True)
class Token:
    """The value of one stream at one stamp: an item, or `Absent`."""

    stamp: int
    value: Any


SAMPLE_HISTORY = 10_000_000_000  # ns of log time; how long samples are kept for messages that are logged late
MIN_SMOOTHING_SAMPLES = 3  # a line through two samples smooths nothing
MAX_INTERVALS = 50  # of a sampled stream, whose median is its interval
MIN_INTERVALS = 3  # with fewer the interval is unknown
GAP_INTERVALS = 1.75  # a longer time between two samples is a gap: at least one sample is missing
MIN_GAP = 200_000_000  # ns; shorter times are no gap, whatever the interval
MIN_GAP_OF_UNKNOWN_INTERVAL = 1_200_000_000  # ns; streams of 1 Hz and more lose nothing at their start
MAX_GIVEN_UP = 100  # unmatched messages remembered, to report by how much their partner came too late

Answer = Token | Loss
Answers = Iterable[Answer]


def _duration(default: int | None, help: str) -> Any:
    return parameter(default, help, unit="ns", low=0)


def _time(nanoseconds: float) -> str:
    """A time in words: "20 ms", "1.5 s"."""
    value, unit = (nanoseconds / 1e6, "ms") if nanoseconds < 1_000_000_000 else (nanoseconds / 1e9, "s")
    return f"{round(value, 3):.15g} {unit}"


@dataclass(frozen=True)
class Pair(Checked):
    """Joins two streams of the same rate into pairs, by the left item's `pair_with(right)`.

    Partners are the first two unpaired messages whose stamps differ by at most `slop`, which must be less than half the
    period of the streams. A pair has the stamp of its left message.
    """

    slop: int = _duration(5_000_000, "largest difference between the two stamps")
    patience: int = _duration(3_000_000_000, "log time to wait for a partner")
    max_waiting: int = parameter(50, "largest number of messages that wait for a partner", low=1)

    ports = ("left", "right")
    clock = None  # pairs are a clock of their own

    @staticmethod
    def output(kinds: dict[str, type]) -> type:
        """The type of the pairs; raises TypeError where the two types do not pair."""
        method = getattr(kinds["left"], "pair_with", None)
        hints = hints_of(method) if method else {}
        if not issubclass(kinds["right"], hints.get("right", ())):
            raise TypeError(f"a {kinds['left'].__name__} cannot be paired with a {kinds['right'].__name__}")
        if not isinstance(hints.get("return"), type):
            raise TypeError(f"{kinds['left'].__name__}.pair_with does not say which one type it returns")
        return hints["return"]  # type: ignore[no-any-return]

    def start(self, name: str, inputs: dict[str, str]) -> PairState:
        """A running aligner; `inputs` maps ports to stream names."""
        return PairState(self, name, inputs)


class PairState:
    """The left and right messages that wait for a partner."""

    def __init__(self, config: Pair, name: str, inputs: dict[str, str]) -> None:
        self.config, self.name, self.inputs = config, name, inputs
        self.waiting: dict[str, deque[tuple[int, Token]]] = {"left": deque(), "right": deque()}
        self.given_up = {port: deque[tuple[int, int]](maxlen=MAX_GIVEN_UP) for port in self.waiting}  # stamp, log time

    def push(self, port: str, log_time: int, token: Token) -> Answers:
        """A message of `port` has arrived."""
        self.waiting[port].append((log_time, token))
        yield from self._match()
        if len(self.waiting[port]) > self.config.max_waiting:
            limit = f"{self.config.max_waiting} messages ({self.name}.max_waiting)"
            yield self._unmatched(port, f"no partner among the next {limit}")

    def _match(self) -> Answers:
        lefts, rights = self.waiting["left"], self.waiting["right"]
        while lefts and rights:
            left, right = lefts[0][1], rights[0][1]
            apart = right.stamp - left.stamp
            if abs(apart) > self.config.slop:
                yield self._unmatched("left" if apart > 0 else "right")
            else:
                lefts.popleft()
                rights.popleft()
                yield Token(left.stamp, _paired(self.name, left, right))

    def tick(self, log_time: int) -> Answers:
        """The log's clock has moved to `log_time`."""
        for port, queue in self.waiting.items():
            while queue and queue[0][0] + self.config.patience < log_time:
                limit = f"{_time(self.config.patience)} of log time ({self.name}.patience)"
                yield self._unmatched(port, f"no partner within {limit}")

    def end(self) -> Answers:
        """The log has ended."""
        for port, queue in self.waiting.items():
            while queue:
                yield self._unmatched(port, "the part of the log that was read ended before its partner came")

    def _unmatched(self, port: str, waited: str = "") -> Loss:
        """Give up the message of `port` that waits longest. waited: for how long, in words, if it waited to a limit."""
        other = "left" if port == "right" else "right"
        arrived, token = self.waiting[port].popleft()
        known = [*self.given_up[other], *((first.stamp, logged) for logged, first in [*self.waiting[other]][:1])]
        apart, logged = min(((abs(stamp - token.stamp), at) for stamp, at in known), default=(math.inf, 0))
        if apart <= self.config.slop:
            late = f"it was logged {_time(arrived - logged)} after its {self.inputs[other]}"
            why = f"{late}, more than {_time(self.config.patience)} ({self.name}.patience)"
        elif waited:
            why = waited
        else:
            limit = f"{_time(self.config.slop)} ({self.name}.slop)"
            why = f"the nearest {self.inputs[other]} without a partner is {_time(apart)} away, more than {limit}"
        self.given_up[port].append((token.stamp, arrived))
        return Loss(self.inputs[port], token.stamp, self.name, LossReason.UNMATCHED, why)


@dataclass(frozen=True)
class _Sampler(Checked):
    """Samples `stream` at the stamps of `at`; its tokens run on the clock of `at`."""

    ports = ("stream", "at")
    clock = "at"
    patience = 0  # ns of log time
    smooth = 0  # ns; how far from a stamp samples are used

    def output(self, kinds: dict[str, type]) -> type:
        """The type of the samples."""
        return kinds["stream"]

    def start(self, name: str, inputs: dict[str, str]) -> SamplerState:
        """A running aligner; `inputs` maps ports to stream names."""
        return SamplerState(self, name, inputs)

    def choose(self, state: SamplerState, stamp: int, final: str) -> Any:
        """The value at `stamp`; or a sentence (str) why there is none; or None to wait for more samples.

        final: empty while more samples may come, else how long the aligner waited, in words; it must not wait then.
        May raise what the methods of the samples raise.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class Interpolate(_Sampler):
    """Interpolates `stream` at the stamps of `at`, by the earlier sample's `interpolated(later, stamp)`.

    With `smooth`, three or more samples around the stamp are smoothed by the type's `smoothed(samples, stamp)`. They
    reach equally far to both sides of the stamp, so that the result does not lag.
    """

    max_gap: int | None = _duration(
        None, "largest time between the two neighbours; none: 1.75 times the stream's interval, at least 200 ms"
    )
    patience: int = _duration(1_000_000_000, "log time to wait for the later neighbour")
    smooth: int = _duration(0, "samples this close to the stamp are smoothed; 0: interpolate between two neighbours")

    def output(self, kinds: dict[str, type]) -> type:
        """The type of the samples; raises TypeError where it lacks the method to interpolate or to smooth them."""
        for method in ("interpolated", "smoothed") if self.smooth else ("interpolated",):
            if not hasattr(kinds["stream"], method):
                raise TypeError(f"a {kinds['stream'].__name__} cannot be {method}")
        return kinds["stream"]

    def choose(self, state: SamplerState, stamp: int, final: str) -> Any:
        before, after = state.neighbours(stamp)
        exact = before is not None and before.stamp == stamp
        awaited = after is None or state.samples[-1].stamp < stamp + self.smooth
        if awaited and not final and (self.smooth or not exact):
            return None
        max_gap = self.max_gap_of(state.intervals)
        wide = before is not None and after is not None and after.stamp - before.stamp > max_gap
        if before is not None and exact and (after is None or wide or not self.smooth):
            return before.value
        if before is None or after is None:
            return state.none(stamp, final)
        if wide:
            limit = f"{_time(max_gap)} ({state.name}.max_gap)"
            return f"{state.stream} has a gap of {_time(after.stamp - before.stamp)}, more than {limit}"
        width = min(self.smooth, stamp - state.samples[0].stamp, state.samples[-1].stamp - stamp)  # equal on both sides
        near = [sample.value for sample in state.samples if abs(sample.stamp - stamp) <= width]
        if len(near) >= MIN_SMOOTHING_SAMPLES:
            return before.value.smoothed(near, stamp)
        return before.value.interpolated(after.value, stamp)

    def max_gap_of(self, intervals: Sequence[int]) -> int:
        """The largest time between two neighbours, ns, in a stream whose last samples had these intervals, ns."""
        if self.max_gap is not None:
            return self.max_gap
        if len(intervals) < MIN_INTERVALS:
            return MIN_GAP_OF_UNKNOWN_INTERVAL
        return max(MIN_GAP, round(GAP_INTERVALS * median_low(intervals)))


@dataclass(frozen=True)
class Nearest(_Sampler):
    """The sample of `stream` nearest to each stamp of `at`, at most `slop` away."""

    slop: int = _duration(50_000_000, "largest time between sample and stamp")
    patience: int = _duration(1_000_000_000, "log time to wait for a nearer sample")

    def choose(self, state: SamplerState, stamp: int, final: str) -> Any:
        before, after = state.neighbours(stamp)
        if after is None and not final and not (before is not None and before.stamp == stamp):
            return None
        neighbours = [sample for sample in (before, after) if sample is not None]
        if not neighbours:
            return state.none(stamp, final)
        found = min(neighbours, key=lambda sample: abs(sample.stamp - stamp))
        apart = abs(found.stamp - stamp)
        if apart > self.slop:
            nearest = f"the nearest {state.stream} sample{'' if after else final} is {_time(apart)} away"
            return f"{nearest}, more than {_time(self.slop)} ({state.name}.slop)"
        return found.value


@dataclass(frozen=True)
class Latest(_Sampler):
    """The last sample of `stream` at or before each stamp of `at`, of those logged by then, whatever its age."""

    def choose(self, state: SamplerState, stamp: int, final: str) -> Any:
        before, _ = state.neighbours(stamp)
        return state.none(stamp, " logged by then") if before is None else before.value


class SamplerState:
    """The stamps that wait for a sample, and the samples that they may need.

    name: the aligner's stream; stream: the sampled one; intervals: ns, the last ones between samples.
    """

    def __init__(self, config: _Sampler, name: str, inputs: dict[str, str]) -> None:
        self.config, self.name, self.stream = config, name, inputs["stream"]
        self.wanted: deque[tuple[int, Token]] = deque()
        self.samples: deque[Token] = deque()
        self.arrivals: deque[int] = deque()
        self.intervals: deque[int] = deque(maxlen=MAX_INTERVALS)
        self.newest: int | None = None  # stamp of the last sample
        self.answered: int | None = None  # the last stamp with an answer

    def push(self, port: str, log_time: int, token: Token) -> Answers:
        """A message of `port` has arrived."""
        if port == "stream":
            if not isinstance(token.value, Absent):
                self.samples.append(token)
                self.arrivals.append(log_time)
                if self.newest is not None:
                    self.intervals.append(token.stamp - self.newest)
                self.newest = token.stamp
        else:
            self.wanted.append((log_time, token))
        yield from self._answer(log_time)
        self._forget(log_time)

    def tick(self, log_time: int) -> Answers:
        """The log's clock has moved to `log_time`."""
        yield from self._answer(log_time)

    def end(self) -> Answers:
        """The log has ended."""
        yield from self._answer(None)

    def _answer(self, log_time: int | None) -> Answers:
        while self.wanted:
            arrived, token = self.wanted[0]
            final = ""
            if log_time is None:
                final = " by the log's end"
            elif arrived + self.config.patience < log_time:
                final = f" within {_time(self.config.patience)} of log time ({self.name}.patience)"
            try:
                value = self.config.choose(self, token.stamp, final)
            except Exception as error:
                value = Absent(Loss(self.name, token.stamp, self.name, LossReason.FAILED, failure(error)))
            if value is None:
                return
            self.wanted.popleft()
            self.answered = token.stamp
            if isinstance(value, str):
                value = Absent(Loss(self.name, token.stamp, self.name, LossReason.UNALIGNED, value))
            yield Token(token.stamp, value)

    def _forget(self, log_time: int) -> None:
        """Drop samples that no later stamp can need, and those older than `SAMPLE_HISTORY`."""
        while len(self.samples) > 1 and (
            (self.answered is not None and self.samples[1].stamp <= self.answered - self.config.smooth)
            or (not self.wanted and self.arrivals[1] + SAMPLE_HISTORY < log_time)
        ):
            self.samples.popleft()
            self.arrivals.popleft()

    def neighbours(self, stamp: int) -> tuple[Token | None, Token | None]:
        """The last sample at or before `stamp` and the first one after it."""
        before = None
        for sample in self.samples:
            if sample.stamp > stamp:
                return before, sample
            before = sample
        return before, None

    def none(self, stamp: int, final: str) -> str:
        """The sentence about missing samples: which ones are missing, and how far away the nearest is."""
        if not self.samples:
            return f"no {self.stream} sample{final}"
        if self.samples[0].stamp > stamp:
            return f"the first {self.stream} sample is {_time(self.samples[0].stamp - stamp)} later"
        return f"no later {self.stream} sample{final}; the last is {_time(stamp - self.samples[-1].stamp)} earlier"


def _paired(name: str, left: Token, right: Token) -> Any:
    """The pair of two items, or `Absent` if one is absent or they do not pair."""
    for token in (left, right):
        if isinstance(token.value, Absent):
            return token.value
    try:
        return left.value.pair_with(right.value)
    except Exception as error:
        return Absent(Loss(name, left.stamp, name, LossReason.FAILED, failure(error)))


pair, interpolate, nearest, latest = Pair, Interpolate, Nearest, Latest
