"""From any checkpoint of a run, another run has the results and the losses of the whole one."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from flow.errors import SinkError, UsageError
from flow.runtime.checkpoint import Checkpoint
from flow.runtime.interrupts import Stop
from flow.runtime.run import run
from tests.flow.toys import MS, Couple, Keep, Kept, Log, Total, graph, traverse

FRAMES = 10
PIPELINE = """
source: {use: tests.flow.toys.Source}
streams:
  both:   {use: flow.align.pair, left: left, right: right, slop: 5 ms}
  height: {use: flow.align.interpolate, stream: level, at: both, max_gap: 120 ms}
  twice:  {use: tests.flow.toys.Scale, couple: both, factor: 2 m, nap: %(nap)s s, bad: %(bad)s}
  total:  {use: tests.flow.toys.Total, couple: twice}
  raised: {use: tests.flow.toys.Add, a: total, b: height}
  fourth: {use: tests.flow.runtime.test_sparse.EachFourth, couple: raised}
sinks: [{use: tests.flow.runtime.test_checkpoint.Continued}]
"""


@dataclass
class Continued(Keep):
    """A sink that can go on."""

    def checkpoint(self) -> list[Any]:
        """The records so far."""
        return list(self.records)

    def resume(self, saved: list[Any]) -> None:
        """Go on behind some records."""
        self.records[:] = saved


@dataclass
class InMemory:
    """Keeps every checkpoint; one follows each frame."""

    last: Checkpoint | None = None
    all: list[Checkpoint] = field(default_factory=list)
    given_up: str = ""

    def due(self) -> bool:
        return True

    def keep(self, checkpoint: Checkpoint) -> None:
        self.last = checkpoint
        self.all.append(checkpoint)

    def give_up(self, why: str) -> None:
        self.given_up = why


def replayed(tmp_path, events, checkpoints=None, workers=3, text=PIPELINE, **options):
    """(what the sink was given, the summary) of a run."""
    pipeline = graph(tmp_path, nap=0.002, bad=[2.0, 6.0], text=text)
    ((use, sink),) = pipeline.sinks
    sink.kept = Kept()
    summary = run(pipeline, Log(events), {use: Path("unused")}, workers=workers, checkpoints=checkpoints, **options)
    return sink.kept.records, summary


def results(records):
    """What does not depend on the time that the work took."""
    return [(record.index, record.stamp, record.items, record.entries, record.unchanged) for record in records]


@pytest.fixture
def events():
    """A traverse with an unpaired image, an unreadable message and two frames without a height."""
    given = traverse(FRAMES)
    given = [event for event in given if event[:2] not in ((300 * MS, "right"), (750 * MS, "level"))]
    return [*given[:8], (210 * MS, "level", ValueError("broken")), *given[8:]]


@pytest.mark.parametrize("workers", [1, 3])
def test_a_run_goes_on_from_each_checkpoint_as_if_it_had_not_ended(tmp_path, events, workers):
    kept = InMemory()
    whole, summary = replayed(tmp_path, events)
    again, _ = replayed(tmp_path, events, kept, workers=workers)
    assert results(again) == results(whole)
    assert kept.all
    for checkpoint in kept.all:
        records, resumed = replayed(tmp_path, events, InMemory(checkpoint))
        assert results(records) == results(whole), checkpoint.frames
        for name in ("verdict", "frames_in", "frames_out", "frames_through", "ledger", "findings", "drops", "messages"):
            assert resumed[name] == summary[name], (checkpoint.frames, name)
        assert resumed["frames_resumed"] == checkpoint.frames
    assert summary["drops"] == {"failed": 2, "unaligned": 2, "unmatched": 1, "unreadable": 1}


def test_a_run_that_was_stopped_goes_on(tmp_path, events):
    whole, _ = replayed(tmp_path, events)
    for frames in range(1, FRAMES - 2):
        stop, kept = Stop(), InMemory()
        through = []

        def advance(complete, stop=stop, frames=frames, through=through):
            through.append(complete)
            if len(through) == frames:
                stop.request()

        _, stopped = replayed(tmp_path, events, kept, stop=stop, on_frame=advance)
        assert stopped["interrupted"]
        records, summary = replayed(tmp_path, events, InMemory(kept.last))
        assert results(records) == results(whole)
        assert not summary["interrupted"]
        assert summary["frames_resumed"] >= frames - 1


def test_no_checkpoint_follows_what_a_stage_gives_at_the_end(tmp_path):
    kept = InMemory()
    records, _ = replayed(tmp_path, traverse(4), kept)
    assert records[-1].items["fourth"]  # only since it is the last frame
    assert max(checkpoint.frames for checkpoint in kept.all) < 4


@dataclass(frozen=True)
class Locked(Total):
    """Has a state that cannot be pickled."""

    def start(self) -> Any:
        """A function."""
        return lambda: None


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (("toys.Total", "runtime.test_checkpoint.Locked"), "the state of 'total' cannot be pickled: "),
        (("runtime.test_checkpoint.Continued", "toys.Keep"), "tests.flow.toys.Keep has no 'checkpoint'"),
    ],
)
def test_what_cannot_go_on_is_refused_before_the_first_frame(tmp_path, change, sentence):
    text = PIPELINE.replace(*change)
    with pytest.raises(UsageError, match=f"this pipeline cannot be resumed: {sentence}.*; leave out --resume"):
        replayed(tmp_path, traverse(3), InMemory(), text=text)
    assert replayed(tmp_path, traverse(3), text=text)[1]["frames_in"] == 3


@dataclass(frozen=True)
class LaterLocked(Total):
    """Has a state that cannot be pickled after two frames."""

    def __call__(self, couple: Couple, *, state: list[Any]) -> Couple:
        """The couple."""
        state.append(couple.value if len(state) < 2 else lambda: None)
        return couple

    def finding(self, state: list[Any]) -> None:
        """Nothing."""


def test_a_state_that_cannot_be_saved_later_ends_the_checkpoints_and_not_the_run(tmp_path, events):
    kept, text = InMemory(), PIPELINE.replace("toys.Total", "runtime.test_checkpoint.LaterLocked")
    records, summary = replayed(tmp_path, events, kept, text=text)
    assert (summary["frames_through"], len(records)) == (FRAMES - 1, FRAMES - 1)
    assert kept.given_up.startswith("the state of 'total' cannot be pickled: ")
    assert max((checkpoint.frames for checkpoint in kept.all), default=0) <= 3  # one of them fails


def test_no_checkpoint_follows_a_frame_that_a_sink_could_not_write(tmp_path):
    kept, pipeline = InMemory(), graph(tmp_path, text=PIPELINE.replace("Continued}", "Continued, fail_at: 5}"))
    ((use, _),) = pipeline.sinks
    with pytest.raises(SinkError):
        run(pipeline, Log(traverse(FRAMES)), {use: Path("unused")}, workers=1, checkpoints=kept)
    assert max(checkpoint.frames for checkpoint in kept.all) <= 5
