"""A stage may have nothing new in a frame, and give what it keeps with the last frame."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import pytest

from flow.contracts import LossReason
from flow.errors import PipelineError
from flow.runtime.engine import Engine
from flow.runtime.ledger import Ledger
from tests.flow.toys import MS, Couple, Keep, Number, graph, replayed, traverse

PIPELINE = """
source: {use: tests.flow.toys.Source}
streams:
  both:   {use: flow.align.pair, left: left, right: right, slop: 5 ms}
  twice:  {use: tests.flow.toys.Scale, couple: both, factor: 2 m}
  fourth: {use: tests.flow.runtime.test_sparse.EachFourth, couple: twice}
  next:   {use: tests.flow.toys.Scale, couple: fourth, factor: 1 m}
sinks: [{use: tests.flow.toys.Keep}]
"""


@dataclass(frozen=True)
class EachFourth:
    """Passes each fourth item on, and the last one."""

    def start(self) -> list[Couple]:
        """The items so far: none."""
        return []

    def __call__(self, couple: Couple, *, state: list[Couple]) -> Couple | None:
        """The item, or None."""
        state.append(couple)
        return couple if len(state) % 4 == 1 else None

    def flush(self, state: list[Couple]) -> Couple | None:
        """The last item, if it was not passed on."""
        return state[-1] if state and len(state) % 4 != 1 else None


@dataclass(frozen=True)
class Dense(EachFourth):
    """Returns None without saying so."""

    def __call__(self, couple: Couple, *, state: list[Couple]) -> Couple:  # type: ignore[override]
        """See above."""
        return None  # type: ignore[return-value]


@dataclass(frozen=True)
class Lagging(EachFourth):
    """Returns the item of the frame before."""

    def __call__(self, couple: Couple, *, state: list[Couple]) -> Couple | None:
        """See above."""
        state.append(couple)
        return state[-2] if len(state) > 1 else None

    def flush(self, state: list[Couple]) -> Couple | None:
        """The last item."""
        return None


@dataclass(frozen=True)
class Stale(EachFourth):
    """Returns the stamp of another frame."""

    def __call__(self, couple: Couple, *, state: list[Couple]) -> Couple | None:
        """See above."""
        return Couple(couple.stamp + 1, 0.0)


@dataclass(frozen=True)
class Stateless:
    """Keeps nothing that it could flush."""

    def __call__(self, couple: Couple) -> Couple:
        """The item."""
        return couple

    def flush(self) -> Couple | None:
        """Nothing."""
        return None


def stamps_of(sink: Any, stream: str) -> list[int]:
    """The frames that have an item of a stream."""
    return [record.index for record in sink.records if stream in record.items]


@pytest.mark.parametrize("workers", [1, 2, 4])
@pytest.mark.parametrize(("frames", "due"), [(1, [0]), (2, [0, 1]), (5, [0, 4]), (11, [0, 4, 8, 10])])
def test_frames_without_anything_new_are_whole(tmp_path, workers, frames, due):
    sink, summary = replayed(graph(tmp_path, text=PIPELINE), traverse(frames), workers=workers)
    assert stamps_of(sink, "fourth") == stamps_of(sink, "next") == due
    assert stamps_of(sink, "twice") == list(range(frames))
    assert (summary["verdict"], summary["frames_out"], summary["ledger"]) == ("COMPLETE", frames, [])
    for record in sink.records:
        assert record.unchanged == (frozenset() if record.index in due else {"fourth", "next"})


def test_a_stage_that_can_flush_may_return_only_earlier_stamps(tmp_path):
    sink, summary = replayed(graph(tmp_path, text=PIPELINE.replace("EachFourth", "Lagging")), traverse(4))
    assert [record.items["fourth"].stamp for record in sink.records[1:]] == [0, 100 * MS, 200 * MS]
    assert summary["verdict"] == "COMPLETE"
    _, summary = replayed(graph(tmp_path, text=PIPELINE.replace("EachFourth", "Stale")), traverse(3))
    assert summary["drops"] == {"failed": 3}
    assert "Stale returned the stamp 1 ns, not that of its frame" in summary["ledger"][0]["detail"]


def test_the_last_frame_flushes_even_if_it_lost_its_input(tmp_path, monkeypatch):
    def scaled(self: Any, couple: Couple) -> Couple:
        if couple.stamp == 600 * MS and self.factor == 2:
            raise ValueError("too bright")
        return couple

    monkeypatch.setattr("tests.flow.toys.Scale.__call__", scaled)
    sink, summary = replayed(graph(tmp_path, text=PIPELINE), traverse(7))
    assert stamps_of(sink, "fourth") == [0, 4, 6]
    assert sink.records[-1].items["next"].stamp == 500 * MS
    assert [(entry["stream"], entry["reason"]) for entry in summary["ledger"]] == [("twice", LossReason.FAILED)]
    assert summary["verdict"] == "INCOMPLETE"


def test_an_engine_with_room_for_one_frame_does_not_wait_for_ever(tmp_path):
    sink, pipeline = Keep(), graph(tmp_path, text=PIPELINE)
    sinks: Mapping[str, Any] = {"keep": (sink, ["fourth"])}
    engine = Engine(pipeline.stages, sinks, Ledger(), workers=1, capacity=1, max_frames=1)
    for index in range(9):
        assert engine.admit(index, {"both": Couple(index, 1.0), "left": Number(index, 1.0)}, [])
    engine.finish()
    assert stamps_of(sink, "fourth") == [0, 4, 8]


def test_none_is_an_item_only_where_the_annotation_says_so(tmp_path):
    text = PIPELINE.replace("test_sparse.EachFourth", "test_sparse.Dense")
    _, summary = replayed(graph(tmp_path, text=text), traverse(3))
    assert {entry["stream"] for entry in summary["ledger"]} == {"fourth"}
    assert "returned NoneType, not Couple" in summary["ledger"][0]["detail"]
    with pytest.raises(PipelineError, match=r"Stateless.flush needs a 'state'"):
        graph(tmp_path, text=PIPELINE.replace("test_sparse.EachFourth", "test_sparse.Stateless"))
