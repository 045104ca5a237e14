"""Toy stages for the runtime's tests: they compute numbers instead of images, so tests see only the dataflow."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

from flow.config.loader import load
from flow.contracts import Finding, Severity, StageError
from flow.runtime.run import run


@dataclass(frozen=True)
class Couple:
    stamp: int
    value: float


@dataclass(frozen=True)
class Number:
    stamp: int
    value: float

    def pair_with(self, right: Number) -> Couple:
        if self.value < 0:
            raise StageError(f"the left number {self.value} is negative")
        return Couple(self.stamp, self.value + right.value)

    def interpolated(self, later: Number, stamp: int) -> Number:
        share = (stamp - self.stamp) / (later.stamp - self.stamp)
        return Number(stamp, (1 - share) * self.value + share * later.value)


@dataclass(frozen=True)
class Place(Number):
    """A pose on a line, its value in metres."""

    def distance_to(self, other: Place) -> float:
        return abs(self.value - other.value)


@dataclass(frozen=True)
class Text:
    stamp: int
    text: str


@dataclass(frozen=True)
class Source:
    streams: ClassVar[Mapping[str, type]] = {
        "left": Number, "right": Number, "level": Number, "words": Text, "way": Place,
    }  # fmt: skip
    gain: float = 1.0

    def open(self, path: Path, *, start: float | None, end: float | None) -> AbstractContextManager[Log]:
        return nullcontext(Log(traverse(3)))


@dataclass(frozen=True)
class Scale:
    """Multiplies; fails on the values of `bad`; sleeps up to `nap` seconds to shuffle the order of completion."""

    factor: float = field(default=1.0, metadata={"unit": "m", "low": 0})
    bad: tuple[float, ...] = ()
    nap: float = field(default=0.0, metadata={"unit": "s"})
    size: int = field(default=1, metadata={"unit": "px"})
    threads: int = 1

    def __post_init__(self) -> None:
        if not self.factor >= 0:
            raise ValueError(f"Scale.factor must be at least 0 m, not {self.factor}")

    def __call__(self, couple: Couple) -> Couple:
        time.sleep(self.nap * random.random())
        if couple.value in self.bad:
            raise StageError(f"cannot scale {couple.value}")
        return Couple(couple.stamp, couple.value * self.factor)


@dataclass(frozen=True)
class Add:
    def __call__(self, a: Couple, b: Couple | Number) -> Couple:
        return Couple(a.stamp, a.value + b.value)


@dataclass(frozen=True)
class Total:
    """The running sum of all frames."""

    def start(self) -> list[float]:
        """The values so far: none."""
        return []

    def __call__(self, couple: Couple, *, state: list[float]) -> Couple:
        state.append(couple.value)
        return Couple(couple.stamp, sum(state))

    def finding(self, state: list[float]) -> Finding | None:
        """The sum of all, a warning from 30 on, a fault at 42; it fails at 12."""
        if sum(state) == 12:
            raise RuntimeError("unlucky")
        severity = Severity.WARNING if sum(state) >= 30 else Severity.NOTE
        severity = Severity.FAULT if sum(state) == 42 else severity
        return Finding(f"the sum is {sum(state)}", severity) if state else None


@dataclass(frozen=True)
class Either:
    """Adds what may be missing."""

    both: bool = False

    def check_inputs(self, connected: set[str]) -> None:
        """Needs both inputs if `both` is set."""
        if self.both and "b" not in connected:
            raise ValueError("Either.both needs a `b`")

    def __call__(self, a: Couple, b: Number | None = None) -> Couple:
        return Couple(a.stamp, a.value + (b.value if b else 0.0))


@dataclass(frozen=True)
class Mute:
    """Does not say what it takes."""

    def __call__(self, a) -> Couple:  # type: ignore[no-untyped-def]
        return Couple(0, 0.0)


@dataclass(frozen=True)
class Liar:
    def __call__(self, couple: Couple) -> Couple:
        return Text(couple.stamp, "not a couple")  # type: ignore[return-value]


@dataclass(frozen=True)
class Late:
    def __call__(self, couple: Couple) -> Couple:
        return replace(couple, stamp=couple.stamp + 1)


class Meter:
    """Counts how many calls are inside at once."""

    def __init__(self) -> None:
        self.lock, self.inside, self.most = threading.Lock(), 0, 0

    def __enter__(self) -> None:
        with self.lock:
            self.inside += 1
            self.most = max(self.most, self.inside)

    def __exit__(self, *_: object) -> None:
        with self.lock:
            self.inside -= 1


@dataclass
class Kept:
    """What a sink was given."""

    records: list[Any] = field(default_factory=list)
    streams: Mapping[str, type] = field(default_factory=dict)
    summary: dict[str, Any] | None = None
    meter: Meter = field(default_factory=Meter)


@dataclass
class Keep:
    """A sink that keeps its records; the copies that runs make of it share `kept`."""

    suffix: ClassVar[str] = ".txt"
    names_streams: ClassVar[tuple[str, ...]] = ("only",)
    only: tuple[str, ...] = ()
    fail_at: int | None = None
    kept: Kept = field(default_factory=Kept)

    def __getattr__(self, name: str) -> Any:
        """The parts of `kept`."""
        if name not in Kept.__dataclass_fields__:
            raise AttributeError(name)
        return getattr(self.kept, name)

    def wants(self, stream: str, kind: type) -> bool:
        return True

    def open(self, path: Path, streams: Mapping[str, type], about: Mapping[str, str]) -> None:
        self.kept.streams = streams

    def write(self, record: Any) -> None:
        with self.meter:
            if record.index == self.fail_at:
                raise OSError("No space left on device")
            self.records.append(record)

    def close(self, summary: Mapping[str, Any]) -> None:
        self.kept.summary = dict(summary)

    def values(self, stream: str) -> dict[int, float]:
        return {r.stamp: r.items[stream].value for r in self.records if stream in r.items}


class Log:
    """A log of given events."""

    def __init__(self, events: list[tuple[int, str, Any]], missing: dict[str, str] | None = None) -> None:
        self.given, self.missing = events, missing or {}
        self.refused: dict[str, str] = {}
        self.frames = None

    def events(self, streams: Collection[str]) -> Iterator[tuple[int, str, Any]]:
        yield from (event for event in self.given if event[1] in {*streams, "log"})

    def notes(self) -> dict[str, str]:
        return {}


MS = 1_000_000
PIPELINE = """
source: {use: tests.flow.toys.Source}
streams:
  both:   {use: flow.align.pair, left: left, right: right}
  height: {use: flow.align.interpolate, stream: level, at: both}
  twice:  {use: tests.flow.toys.Scale, couple: both, factor: 2 m, nap: %(nap)s s, bad: %(bad)s}
  thrice: {use: tests.flow.toys.Scale, couple: both, factor: 3 m, nap: %(nap)s s}
  sum:    {use: tests.flow.toys.Add, a: twice, b: thrice}
  raised: {use: tests.flow.toys.Add, a: sum, b: height}
  total:  {use: tests.flow.toys.Total, couple: twice}
sinks:
  - {use: tests.flow.toys.Keep, fail_at: %(fail_at)s}
"""


def graph(tmp_path, nap=0.0, bad=(), fail_at="null", text=PIPELINE):
    file = tmp_path / "toy.yaml"
    file.write_text(text % {"nap": nap, "bad": list(bad), "fail_at": fail_at})
    return load(str(file))


def traverse(frames, start=0):
    """Frames each 100 ms, their number as value; the level is sampled in between and equals the time in seconds."""
    events = [(-50 * MS, "level", Number(-50 * MS, -0.05))]
    for index in range(start, start + frames):
        at = index * 100 * MS
        events += [(at, "left", Number(at, float(index))), (at, "right", Number(at, 0.0))]
        events += [(at + 50 * MS, "level", Number(at + 50 * MS, at / 1e9 + 0.05))]
    return events


def replayed(graph, events, **options):
    """(sink, summary) of a run; the sink is kept by the graph."""
    return replayed_log(graph, Log(events), **options)


def replayed_log(graph, log, **options):
    """(sink, summary) of a run of a log."""
    ((use, sink),) = graph.sinks
    return sink, run(graph, log, {use: Path("unused")}, **options)


def sink_of(graph):
    """The only sink of a graph."""
    ((_, sink),) = graph.sinks
    return sink
