"""The engine bounds what is in memory: frames in flight, large stages at work, items that wait for a sink."""

import threading
import weakref

import pytest

from flow.contracts import FrameRecord
from flow.runtime.engine import Engine
from flow.runtime.ledger import Ledger
from tests.flow.toys import Couple, Keep, Meter, Scale, graph, replayed, traverse


class Encoding(Keep):
    """A sink that prepares texts; it meets one worker more while it prepares `meet_at`."""

    def __init__(self, meet_at=-1.0, bad=-1.0):
        super().__init__()
        self.meet_at, self.bad, self.meeting = meet_at, bad, threading.Barrier(2)

    def prepare(self, stream, item):
        if item.value == self.meet_at and stream in ("twice", "thrice"):
            self.meeting.wait(5)
        if item.value == self.bad:
            raise OSError("cannot encode")
        return f"{stream} {item.value:g}"


def run_with(sink, pipeline, frames, workers=2, streams=("both", "twice", "thrice")):
    ledger = Ledger()
    engine = Engine(pipeline.stages, {"sink": (sink, streams)}, ledger, workers=workers)
    for index in range(frames):
        engine.admit(index, {"both": Couple(index, float(index)), "height": Couple(index, 0.0)}, [])
    engine.finish()
    return engine, ledger


def test_a_sink_gets_what_it_prepared_in_order(tmp_path):
    engine, _ = run_with(sink := Encoding(), graph(tmp_path, bad=[2.0]), 6, workers=4)
    texts = [dict(record.items) for record in sink.records]
    whole = [{"both": f"both {i}", "twice": f"twice {2 * i}", "thrice": f"thrice {3 * i}"} for i in range(6)]
    del whole[2]["twice"]
    assert texts == whole
    assert isinstance(sink.records[0], FrameRecord)
    assert set(sink.records[0].seconds) == {"twice", "thrice", "sum", "raised", "total", "sink"}
    assert sink.records[0].seconds["sink"] == 0 < sink.records[-1].seconds["sink"] < engine.seconds["sink"]
    assert engine.seconds["sink"] >= 0
    assert not any("sink:" in name for name in engine.seconds)


def test_two_workers_prepare_items_of_one_frame_at_once(tmp_path):
    engine, _ = run_with(sink := Encoding(meet_at=0.0), graph(tmp_path), 1)
    assert (engine.failure, len(sink.records)) == (None, 1)


def test_a_sink_that_cannot_prepare_an_item_stops_the_run(tmp_path):
    engine, ledger = run_with(Encoding(bad=3.0), graph(tmp_path), 2)
    assert engine.failure[0] == "sink"
    failed = [(entry.stage, entry.detail.split(" (")[0]) for entry in ledger.entries if entry.reason == "failed"]
    assert failed == [("sink", "OSError: cannot encode")]


@pytest.mark.parametrize(("kind", "streams"), [(Keep, ["sum"]), (Encoding, ["twice", "thrice"])])
def test_an_item_is_let_go_once_it_is_read_or_prepared(tmp_path, monkeypatch, kind, streams):
    made, alive, scale = [], [], Scale.__call__

    def noted(self, couple: Couple) -> Couple:
        made.append(weakref.ref(result := scale(self, couple)))
        return result

    def looking(self, record):
        alive.extend(reference() for reference in made)
        write(self, record)

    write, sink = Keep.write, kind()
    monkeypatch.setattr(Keep, "write", looking)
    monkeypatch.setattr(Scale, "__call__", noted)
    engine, _ = run_with(sink, graph(tmp_path), 1, workers=1, streams=streams)
    assert alive == [None, None]
    assert (list(sink.records[0].items), engine.complete) == (streams, 1)


@pytest.mark.parametrize(("workers", "at_once"), [(1, 1), (2, 1), (4, 2)])
def test_every_second_worker_at_most_is_in_a_large_stage(tmp_path, monkeypatch, workers, at_once):
    meter, scale = Meter(), Scale.__call__

    def metered(self, couple: Couple) -> Couple:
        with meter:
            return scale(self, couple)

    monkeypatch.setattr(Scale, "__call__", metered)
    monkeypatch.setattr(Scale, "large", True, raising=False)
    _, summary = replayed(graph(tmp_path, nap=0.002), traverse(40), workers=workers)
    assert meter.most == at_once
    assert summary["verdict"] == "COMPLETE"


def test_frames_in_flight_are_bounded(tmp_path):
    pipeline, gate = graph(tmp_path), threading.Event()

    class Waiting(Keep):
        def write(self, record):
            gate.wait(5)

    engine = Engine(pipeline.stages, {"sink": (Waiting(), [])}, Ledger(), workers=2, capacity=8, max_frames=3)
    values = {"both": Couple(0, 0.0), "height": Couple(0, 0.0)}
    tries = iter(range(3))
    admitted = [engine.admit(i, values, [], stop=lambda: next(tries, None) is None) for i in range(4)]
    gate.set()
    engine.finish()
    assert admitted == [True, True, True, False]
