"""The engine bounds what is in memory: frames in flight, large stages at work, items that are still read."""

import threading
import weakref

import pytest

from flow.runtime.engine import Engine
from flow.runtime.ledger import Ledger
from tests.flow.toys import Couple, Keep, Meter, Scale, graph, replayed, traverse


def test_an_item_is_let_go_once_it_is_read(tmp_path, monkeypatch):
    made, alive, scale = [], [], Scale.__call__

    def noted(self, couple: Couple) -> Couple:
        made.append(weakref.ref(result := scale(self, couple)))
        return result

    def looking(self, record):
        alive.extend(reference() for reference in made)
        write(self, record)

    write, sink = Keep.write, Keep()
    monkeypatch.setattr(Keep, "write", looking)
    monkeypatch.setattr(Scale, "__call__", noted)
    engine = Engine(graph(tmp_path).stages, {"sink": (sink, ["sum"])}, Ledger(), workers=1)
    engine.admit(0, {"both": Couple(0, 0.0), "height": Couple(0, 0.0)}, [])
    engine.finish()
    assert alive == [None, None]
    assert (list(sink.records[0].items), engine.complete) == (["sum"], 1)


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
