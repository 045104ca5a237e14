"""The engine delivers every frame once, in order, to every sink, despite failures and with any number of workers."""

import threading
import time
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flow.contracts import Absent, Loss, LossReason
from flow.runtime.engine import Engine
from flow.runtime.graph import Node, YamlLocation
from flow.runtime.ledger import Ledger
from tests.flow.toys import MS, PIPELINE, Couple, Keep, Number, graph, replayed, traverse


def test_every_stream_of_every_frame_arrives_in_stamp_order(tmp_path):
    sink, summary = replayed(graph(tmp_path, nap=0.003), traverse(40), workers=4)
    assert [record.index for record in sink.records] == list(range(40))
    assert sink.values("sum") == {i * 100 * MS: 5.0 * i for i in range(40)}
    assert sink.values("raised") == pytest.approx({i * 100 * MS: 5.0 * i + i * 0.1 for i in range(40)})
    assert summary["verdict"] == "COMPLETE"
    assert (summary["frames_in"], summary["frames_out"], summary["drops"]) == (40, 40, {})
    assert 0 < summary["start_seconds"] <= summary["wall_seconds"]
    assert sink.meter.most == 1  # a sink is never entered twice at once


def test_the_most_downstream_work_goes_first(tmp_path, monkeypatch):
    calls, gate = [], threading.Event()
    text = f"""{PIPELINE[: PIPELINE.index("  thrice:")]}
  next: {{use: tests.flow.toys.Scale, couple: twice}}
  last: {{use: tests.flow.toys.Scale, couple: next}}
sinks: [{{use: tests.flow.toys.Keep}}]
"""
    pipeline = graph(tmp_path, text=text)

    def noted(self, couple):
        gate.wait(5)
        calls.append(couple.stamp)
        return couple

    monkeypatch.setattr("tests.flow.toys.Scale.__call__", noted)
    engine = Engine(pipeline.stages, {}, Ledger(), workers=1, capacity=4)
    for index in range(4):
        engine.admit(index, frame(index), [])
    gate.set()
    engine.finish()
    assert calls == [0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3]


class SlowAdd:
    """Joins two streams slowly, frame by frame."""

    def start(self) -> None:
        """No state but None; the stage still gets one frame at a time."""

    def __call__(self, a: Couple, b: Couple, *, state: None) -> Couple:
        time.sleep(0.01)
        return a


@pytest.mark.parametrize("workers", [2, 8])
def test_the_inbox_of_a_join_stays_bounded(tmp_path, monkeypatch, workers):
    text = f"""{PIPELINE[: PIPELINE.index("  twice:")]}
  twice:  {{use: tests.flow.toys.Scale, couple: both, nap: 2 ms}}
  thrice: {{use: tests.flow.toys.Scale, couple: both, nap: 2 ms}}
  sum:    {{use: tests.flow.toys.Add, a: twice, b: thrice}}
sinks: [{{use: tests.flow.toys.Keep}}]
"""
    loaded = graph(tmp_path, text=text).stages
    stages = [replace(node, actor=SlowAdd()) if node.name == "sum" else node for node in loaded]
    engine, most, expect = Engine(stages, {}, Ledger(), workers=workers, capacity=2), [0], Engine._expect

    def watched(self, *arguments):
        expect(self, *arguments)
        most.append(max(len(work.inbox) for work in self._work))

    monkeypatch.setattr(Engine, "_expect", watched)
    for index in range(30):
        engine.admit(index, {"both": Couple(index, 1.0)}, [])
    engine.finish()
    assert max(most) == 2


def test_a_frame_without_inputs_is_through_at_once(tmp_path):
    completeness, ledger = [], Ledger()
    engine = Engine(graph(tmp_path).stages, {}, ledger, on_frame=completeness.append)
    lost = Absent(ledger.add(Loss("both", 0, "both", LossReason.FAILED, "lost")))
    assert engine.admit(0, {"both": lost, "height": Number(0, 0.0)}, [])
    engine.finish()
    assert completeness == [False]


def frame(index):
    """The streams that a frame of the toys' pipeline starts with."""
    return {"both": Couple(index, 1.0), "height": Number(index, 0.0)}


def test_a_stopped_engine_waits_for_a_sink_at_work(tmp_path):
    inside, gate, ledger = threading.Event(), threading.Event(), Ledger()

    class Slow(Keep):
        def write(self, record):
            inside.set()
            gate.wait(5)
            super().write(record)

    engine = Engine(graph(tmp_path).stages, {"slow": (sink := Slow(), ["sum"])}, ledger, workers=1)
    engine.admit(0, frame(0), [])
    inside.wait(5)
    threading.Timer(0.2, gate.set).start()
    engine.finish(lambda: True)
    assert (len(sink.records), engine.through, len(ledger)) == (1, 1, 0)


def test_an_abandoned_frame_reports_only_its_losses_so_far(tmp_path, monkeypatch):
    inside, gate, ledger = threading.Event(), threading.Event(), Ledger()
    completeness, stages = [], graph(tmp_path).stages

    def hang(self, couple):
        inside.set()
        gate.wait(5)
        raise ValueError("too late")

    monkeypatch.setattr("tests.flow.toys.Scale.__call__", hang)
    engine = Engine(stages, {}, ledger, workers=1, on_frame=completeness.append)
    lost = ledger.add(Loss("level", 0, "source", LossReason.UNREADABLE, "chunk 7 is damaged"))
    engine.admit(0, frame(0), [lost])
    inside.wait(5)
    engine.finish(lambda: True)
    gate.set()
    for thread in threading.enumerate():
        if thread.name.startswith("worker-"):
            thread.join(5)
    abandoned = Loss("frame", 0, "engine", LossReason.ABANDONED, "the run ended before the frame was finished")
    assert engine.late_entries == [lost, abandoned]
    assert set(ledger.entries) == {lost, abandoned}
    assert (completeness, engine.through) == ([], 0)


class Sum:
    """A stage of any number of inputs: the sum of their values plus one; fails on the frames in `bad`."""

    def __init__(self, bad):
        self.bad = bad

    def __call__(self, **inputs):
        stamp = next(iter(inputs.values())).stamp
        if stamp in self.bad:
            raise ValueError("bad")
        return Couple(stamp, 1 + sum(item.value for item in inputs.values()))


class OrderedSum(Sum):
    """The same, with the stamps so far as its state."""

    def start(self):
        return []

    def __call__(self, *, state, **inputs):
        state.append(next(iter(inputs.values())).stamp)
        return super().__call__(**inputs)


@st.composite
def dataflows(draw):
    """(inputs, ordered, bad frames) of each stage of a random graph; a stage reads the entry, -1, or those below it."""
    stages = []
    for index in range(draw(st.integers(1, 7))):
        inputs = draw(st.sets(st.integers(-1, index - 1), min_size=1, max_size=3))
        stages.append((sorted(inputs), draw(st.booleans()), draw(st.sets(st.integers(0, 11), max_size=3))))
    return stages


@settings(max_examples=150, deadline=None)  # the only property of the scheduler
@given(
    flow=dataflows(), lost=st.sets(st.integers(0, 11), max_size=4),
    workers=st.integers(1, 5), capacity=st.integers(1, 3), sinks=st.integers(0, 2),
)  # fmt: skip
def test_random_graphs_with_failures_give_the_values_computed_by_hand(flow, lost, workers, capacity, sinks):
    names = {-1: "entry", **{i: f"s{i}" for i in range(len(flow))}}
    place = YamlLocation("random", 1)
    sums = [(OrderedSum if ordered else Sum)(bad) for _, ordered, bad in flow]
    nodes = [
        Node(names[i], "Sum", sums[i], {names[j]: names[j] for j in inputs}, Couple, "entry", False, place)
        for i, (inputs, _, _) in enumerate(flow)
    ]
    keeps = {f"sink{i}": (Keep(), list(names.values())) for i in range(sinks)}
    ledger = Ledger()
    engine = Engine(nodes, keeps, ledger, workers=workers, capacity=capacity)
    for frame in range(12):
        entry = Couple(frame, 0.0)
        if frame in lost:
            entry = Absent(ledger.add(Loss("entry", frame, "source", LossReason.UNALIGNED, "lost")))
        assert engine.admit(frame, {"entry": entry}, [])
    engine.finish()
    expected = [({}, 1) if frame in lost else by_hand(flow, frame) for frame in range(12)]
    assert engine.complete == sum(len(values) == len(flow) for values, _ in expected)
    assert len(ledger) == sum(failures for _, failures in expected)
    for keep, _ in keeps.values():
        assert [record.index for record in keep.records] == list(range(12))
        for record, (values, failures) in zip(keep.records, expected, strict=True):
            assert {name: item.value for name, item in record.items.items() if name != "entry"} == values
            assert len(record.entries) == failures
    for stamps in engine.states.values():
        assert stamps == sorted(stamps)


def by_hand(flow, frame):
    """The values of the stages that work on a frame, and how many fail themselves."""
    values, failures = {"entry": 0.0}, 0
    for i, (inputs, _, bad) in enumerate(flow):
        names = ["entry" if j < 0 else f"s{j}" for j in inputs]
        if all(name in values for name in names):
            if frame in bad:
                failures += 1
            else:
                values[f"s{i}"] = 1 + sum(values[name] for name in names)
    del values["entry"]
    return values, failures
