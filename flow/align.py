"""Alignment: joining streams that run on different clocks, with a bound on how long to wait for a partner.

Each aligner is a small state machine fed with messages in log-time order. It answers with tokens, one for every stamp
of the clock it aligns to: the joined item, or `Absent` with the ledger entry that says why. What it decides depends on
nothing but the order of the log, so that a replay always decides the same.

Its watermark: a waiting message gives up when its partner's stream has moved past it, or when the log's clock has
moved on by `patience` since it arrived, whichever comes first.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice
from typing import Any

from flow.contracts import Absent, Loss, LossReason
from flow.parameters import check_parameters, parameter
from flow.runtime.graph import hints_of
from flow.runtime.ledger import failure

__all__ = ["interpolate", "latest", "nearest", "pair"]  # as pipeline files name them


@dataclass(frozen=True)
class Token:
    """What one stream has for one stamp: an item, or `Absent`."""

    stamp: int
    value: Any


# How long, ns of log time, samples are kept for messages that are logged later than they are stamped.
HISTORY = 10_000_000_000
SMOOTHED = 3  # samples that smoothing needs; a line through two smooths nothing
GIVEN_UP = 100  # messages without a partner that are remembered, to say by how much their partner came too late

Answer = Token | Loss
Answers = Iterable[Answer]


def _duration(default: int | None, help: str) -> Any:
    return parameter(default, help, unit="ns", low=0)


def _time(nanoseconds: int) -> str:
    return f"{round(nanoseconds / 1e6, 3)} ms" if nanoseconds < 10_000_000_000 else f"{nanoseconds / 1e9:.1f} s"


@dataclass(frozen=True)
class Pair:
    """Joins two streams of the same rate into one new stream through the left item's `pair_with(right)`.

    Partners are the first two not yet paired whose stamps differ by at most `slop`, which must be below half the period
    of the streams; the pair carries the left's stamp.
    """

    slop: int = _duration(5_000_000, "largest difference between the two stamps")
    patience: int = _duration(1_000_000_000, "how long on the log's clock to wait for a partner")

    ports = ("left", "right")
    clock = None  # pairs are the beat of a clock of their own

    def __post_init__(self) -> None:
        check_parameters(self)

    @staticmethod
    def output(kinds: dict[str, type]) -> type:
        """The type of the pairs; raises TypeError where the left type cannot be paired with the right one."""
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
    """The lefts and rights still waiting for each other."""

    def __init__(self, rule: Pair, name: str, inputs: dict[str, str]) -> None:
        self.rule, self.name, self.inputs = rule, name, inputs
        self.waiting: dict[str, deque[tuple[int, Token]]] = {"left": deque(), "right": deque()}
        self.given_up = {port: deque[tuple[int, int]](maxlen=GIVEN_UP) for port in self.waiting}  # stamp, log time

    def push(self, port: str, log_time: int, token: Token) -> Answers:
        """A message of `port` has arrived."""
        self.waiting[port].append((log_time, token))
        yield from self._match()

    def _match(self) -> Answers:
        lefts, rights = self.waiting["left"], self.waiting["right"]
        while lefts and rights:
            left, right = lefts[0][1], rights[0][1]
            apart = right.stamp - left.stamp
            if abs(apart) > self.rule.slop:
                yield self._unmatched("left" if apart > 0 else "right")
            else:
                lefts.popleft(), rights.popleft()
                yield Token(left.stamp, _paired(self.name, left, right))

    def tick(self, log_time: int) -> Answers:
        """The log's clock has moved to `log_time`."""
        for port, queue in self.waiting.items():
            while queue and queue[0][0] + self.rule.patience < log_time:
                limit = f"{_time(self.rule.patience)} of log time ({self.name}.patience)"
                yield self._unmatched(port, f"no partner within {limit}")

    def end(self) -> Answers:
        """The log has ended."""
        for port, queue in self.waiting.items():
            while queue:
                yield self._unmatched(port, "the log ended before its partner came")

    def _unmatched(self, port: str, why: str = "") -> Loss:
        """Give up the first that waits. why: what to say unless its partner was given up before it came; where there is
        nothing, how far off the nearest is that waits or was given up."""
        other = "left" if port == "right" else "right"
        arrived, token = self.waiting[port].popleft()
        others = [*self.given_up[other], *((first.stamp, at) for at, first in islice(self.waiting[other], 1))]
        apart, logged = min(((abs(stamp - token.stamp), at) for stamp, at in others), default=(None, 0))
        if apart is not None and apart <= self.rule.slop:
            late = f"it was logged {_time(arrived - logged)} after its {self.inputs[other]}"
            why = f"{late}, more than {_time(self.rule.patience)} ({self.name}.patience)"
        elif apart is not None and not why:
            limit = f"{_time(self.rule.slop)} ({self.name}.slop)"
            why = f"the nearest {self.inputs[other]} without a partner is {_time(apart)} away, more than {limit}"
        self.given_up[port].append((token.stamp, arrived))
        return Loss(self.inputs[port], token.stamp, self.name, LossReason.UNMATCHED, why)


@dataclass(frozen=True)
class _Sampler:
    """Looks up `stream` at the stamps of `at`; its tokens run on the clock of `at`."""

    ports = ("stream", "at")
    clock = "at"
    patience: int

    def __post_init__(self) -> None:
        check_parameters(self)

    def output(self, kinds: dict[str, type]) -> type:
        """The type of the samples."""
        return kinds["stream"]

    @property
    def reach(self) -> int:
        """How far before a stamp samples are wanted, ns."""
        return 0

    def start(self, name: str, inputs: dict[str, str]) -> SamplerState:
        """A running aligner; `inputs` maps ports to stream names."""
        return SamplerState(self, name, inputs)

    def choose(self, node: str, name: str, stamp: int, samples: deque[Token], final: str) -> Any:
        """The value at `stamp`, or a sentence (str) why there is none, or None to wait (never when `final`, which tells
        until when the stream, `name`, was waited for). May raise what the samples' type does.

        node: whose settings the sentence names.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class Interpolate(_Sampler):
    """Interpolates `stream` at the stamps of `at`, through the earlier sample's `interpolated(later, stamp)`.

    With `smooth`, all samples that near to the stamp take part, where there are three and more, through the type's
    `smoothed(samples, stamp)`; as far on one side as on the other, so that nothing lags.
    """

    max_gap: int = _duration(200_000_000, "largest distance between the two neighbours")
    patience: int = _duration(1_000_000_000, "how long on the log's clock to wait for the later neighbour")
    smooth: int = _duration(0, "how far from the stamp samples take part; 0: the two neighbours")

    @property
    def reach(self) -> int:
        """How far before a stamp samples are wanted, ns."""
        return self.smooth

    def output(self, kinds: dict[str, type]) -> type:
        """The type of the samples; raises TypeError where they cannot be interpolated, or not be smoothed."""
        for method in ("interpolated", "smoothed") if self.smooth else ("interpolated",):
            if not hasattr(kinds["stream"], method):
                raise TypeError(f"a {kinds['stream'].__name__} cannot be {method}")
        return kinds["stream"]

    def choose(self, node: str, name: str, stamp: int, samples: deque[Token], final: str) -> Any:
        before, after = _neighbours(samples, stamp)
        exact = before is not None and before.stamp == stamp
        if not final and (after is None or samples[-1].stamp < stamp + self.smooth) and (self.smooth or not exact):
            return None
        wide = before is not None and after is not None and after.stamp - before.stamp > self.max_gap
        if before is not None and exact and (after is None or wide or not self.smooth):
            return before.value
        if before is None or after is None:
            return _none(name, stamp, samples, final)
        if wide:
            limit = f"{_time(self.max_gap)} ({node}.max_gap)"
            return f"{name} has a gap of {_time(after.stamp - before.stamp)}, more than {limit}"
        near = self._near(samples, stamp)
        if len(near) >= SMOOTHED:
            return before.value.smoothed(near, stamp)
        return before.value.interpolated(after.value, stamp)

    def _near(self, samples: deque[Token], stamp: int) -> list[Any]:
        """The samples that `smooth` allows, as far on one side of the stamp as on the other."""
        if not self.smooth:
            return []
        width = min(self.smooth, stamp - samples[0].stamp, samples[-1].stamp - stamp)
        return [sample.value for sample in samples if abs(sample.stamp - stamp) <= width]


@dataclass(frozen=True)
class Nearest(_Sampler):
    """The sample of `stream` nearest to each stamp of `at`, at most `slop` away."""

    slop: int = _duration(50_000_000, "largest distance from the stamp")
    patience: int = _duration(1_000_000_000, "how long on the log's clock to wait for a nearer sample")

    def choose(self, node: str, name: str, stamp: int, samples: deque[Token], final: str) -> Any:
        before, after = _neighbours(samples, stamp)
        if after is None and not final and not (before is not None and before.stamp == stamp):
            return None
        found = min((s for s in (before, after) if s is not None), key=lambda s: abs(s.stamp - stamp), default=None)
        if found is None:
            return _none(name, stamp, samples, final)
        if abs(found.stamp - stamp) > self.slop:
            nearest = f"the nearest {name} sample{'' if after else final} is {_time(abs(found.stamp - stamp))} away"
            return f"{nearest}, more than {_time(self.slop)} ({node}.slop)"
        return found.value


@dataclass(frozen=True)
class Latest(_Sampler):
    """The last sample of `stream` at or before each stamp of `at`, of those that the log has brought by then."""

    max_age: int | None = _duration(None, "oldest sample that still counts; none: any age")
    patience: int = _duration(0, "how long on the log's clock to wait for samples that are logged late")

    def choose(self, node: str, name: str, stamp: int, samples: deque[Token], final: str) -> Any:
        before, after = _neighbours(samples, stamp)
        if after is None and not final and self.patience:
            return None
        if before is None:
            return _none(name, stamp, samples, final or f" logged by then ({node}.patience)")
        if self.max_age is not None and stamp - before.stamp > self.max_age:
            limit = f"{_time(self.max_age)} ({node}.max_age)"
            return f"the last {name} sample is {_time(stamp - before.stamp)} old, more than {limit}"
        return before.value


class SamplerState:
    """Stamps that wait for their sample, and the samples that may still be wanted."""

    def __init__(self, rule: _Sampler, name: str, inputs: dict[str, str]) -> None:
        self.rule, self.name, self.stream = rule, name, inputs["stream"]
        self.wanted: deque[tuple[int, Token]] = deque()
        self.samples: deque[Token] = deque()
        self.arrivals: deque[int] = deque()
        self.passed: int | None = None  # the last stamp that has had its answer

    def push(self, port: str, log_time: int, token: Token) -> Answers:
        """A message of `port` has arrived."""
        if port == "stream":
            if not isinstance(token.value, Absent):
                self.samples.append(token)
                self.arrivals.append(log_time)
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
            elif arrived + self.rule.patience < log_time:
                final = f" within {_time(self.rule.patience)} of log time ({self.name}.patience)"
            try:
                value = self.rule.choose(self.name, self.stream, token.stamp, self.samples, final)
            except Exception as error:
                value = Absent(Loss(self.name, token.stamp, self.name, LossReason.FAILED, failure(error)))
            if value is None:
                return
            self.wanted.popleft()
            self.passed = token.stamp
            if isinstance(value, str):
                value = Absent(Loss(self.name, token.stamp, self.name, LossReason.UNALIGNED, value))
            yield Token(token.stamp, value)

    def _forget(self, log_time: int) -> None:
        """Drop the samples before the last one at or before every stamp to come, and those beyond `HISTORY`."""
        while len(self.samples) > 1 and (
            (self.passed is not None and self.samples[1].stamp <= self.passed - self.rule.reach)
            or (not self.wanted and self.arrivals[1] + HISTORY < log_time)
        ):
            self.samples.popleft(), self.arrivals.popleft()


def _neighbours(samples: deque[Token], stamp: int) -> tuple[Token | None, Token | None]:
    """The last sample at or before `stamp` and the first one after it."""
    before = None
    for sample in samples:
        if sample.stamp > stamp:
            return before, sample
        before = sample
    return before, None


def _none(name: str, stamp: int, samples: deque[Token], final: str) -> str:
    """That there is no sample, or none on one side of the stamp: which then, and by how much the nearest is off."""
    if not samples:
        return f"no {name} sample{final}"
    if samples[0].stamp > stamp:
        return f"the first {name} sample at hand is {_time(samples[0].stamp - stamp)} after it"
    return f"no {name} sample after it{final}; the last is {_time(stamp - samples[-1].stamp)} before it"


def _paired(name: str, left: Token, right: Token) -> Any:
    """The pair of two items, or `Absent` if one is absent or they do not fit."""
    for token in (left, right):
        if isinstance(token.value, Absent):
            return token.value
    try:
        return left.value.pair_with(right.value)
    except Exception as error:
        return Absent(Loss(name, left.stamp, name, LossReason.FAILED, failure(error)))


pair, interpolate, nearest, latest = Pair, Interpolate, Nearest, Latest
