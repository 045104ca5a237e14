"""The engine delivers every frame once, in order, to every sink, whatever fails or how many workers there are."""

import threading
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flow.engine import Engine
from flow.errors import SinkError, UsageError
from flow.ledger import Ledger
from flow.pipeline import load
from flow.run import Stop, run
from tests.flow.toys import Couple, Keep, Log, Number

MS = 1_000_000

PIPELINE = """
source: {use: tests.flow.toys.Source}
streams:
  both:   {use: flow.align.pair, left: left, right: right}
  height: {use: flow.align.interpolate, stream: level, at: both}
  twice:  {use: tests.flow.toys.Scale, couple: both, factor: 2, nap: %(nap)s, bad: %(bad)s}
  thrice: {use: tests.flow.toys.Scale, couple: both, factor: 3, nap: %(nap)s}
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
    ((use, sink),) = graph.sinks
    return sink, run(graph, Log(events), {use: Path("unused")}, **options)


def test_every_stream_of_every_frame_arrives_in_stamp_order(tmp_path):
    sink, summary = replayed(graph(tmp_path, nap=0.003), traverse(40), workers=4)
    assert [record.index for record in sink.records] == list(range(40))
    assert sink.values("sum") == {i * 100 * MS: 5.0 * i for i in range(40)}
    assert sink.values("raised") == pytest.approx({i * 100 * MS: 5.0 * i + i * 0.1 for i in range(40)})
    assert summary["verdict"] == "COMPLETE"
    assert (summary["frames_in"], summary["frames_out"], summary["drops"]) == (40, 40, {})


def test_a_stage_that_remembers_sees_the_frames_in_order(tmp_path):
    sink, _ = replayed(graph(tmp_path, nap=0.003), traverse(30), workers=4)
    assert list(sink.values("total").values()) == [float(sum(2 * j for j in range(i + 1))) for i in range(30)]


def test_a_sink_is_never_entered_twice_at_once(tmp_path):
    sink, _ = replayed(graph(tmp_path, nap=0.002), traverse(30), workers=4)
    assert sink.meter.most == 1


def test_a_failing_frame_is_recorded_and_skipped_and_the_others_go_on(tmp_path):
    sink, summary = replayed(graph(tmp_path, bad=[3.0, 7.0]), traverse(10), workers=3)
    assert list(sink.values("sum").values()) == [5.0 * i for i in range(10) if i not in (3, 7)]
    assert list(sink.values("thrice").values()) == [3.0 * i for i in range(10)]
    assert summary["verdict"] == "INCOMPLETE"
    assert summary["drops"] == {"failed": 2}
    assert [(entry["stage"], entry["detail"]) for entry in summary["ledger"]] == [
        ("twice", "cannot scale 3.0"),
        ("twice", "cannot scale 7.0"),
    ]
    assert [r.index for r in sink.records if r.entries] == [3, 7]


def test_frames_without_a_partner_in_another_stream_are_in_the_ledger(tmp_path):
    events = [event for event in traverse(10) if not (event[1] == "level" and event[0] > 500 * MS)]
    sink, summary = replayed(graph(tmp_path), events)
    assert list(sink.values("raised")) == [i * 100 * MS for i in range(5)]
    assert summary["drops"] == {"unaligned": 5}
    assert list(sink.values("sum").values()) == [5.0 * i for i in range(10)]


def test_an_unreadable_message_and_a_repeated_stamp_are_in_the_ledger(tmp_path):
    events = traverse(4)
    events.insert(3, (10 * MS, "left", OSError("chunk 7 is damaged")))
    events.insert(3, (11 * MS, "left", Number(0, 5.0)))
    sink, summary = replayed(graph(tmp_path), events)
    assert summary["drops"] == {"out of order": 1, "unreadable": 1}
    assert len(sink.values("raised")) == 4


def test_a_stage_that_returns_something_else_fails_the_frame_not_the_run(tmp_path):
    text = PIPELINE.replace("tests.flow.toys.Add, a: sum, b: height", "tests.flow.toys.Liar, couple: sum")
    _, summary = replayed(graph(tmp_path, text=text), traverse(2))
    assert summary["drops"] == {"failed": 2}
    assert "returned a Text, not a Couple" in summary["ledger"][0]["detail"]


def test_a_failing_sink_stops_the_run_and_is_still_closed(tmp_path):
    pipeline = graph(tmp_path, fail_at=5)
    ((_, sink),) = pipeline.sinks
    with pytest.raises(SinkError, match=r"Keep could not write unused: No space left on device"):
        replayed(pipeline, traverse(1000), workers=2)
    assert len(sink.records) == 5
    assert sink.summary["verdict"] == "INCOMPLETE"


def test_a_log_that_breaks_off_keeps_what_was_read(tmp_path):
    class Broken(Log):
        def __iter__(self):
            yield from self.events
            raise OSError("input/output error")

    pipeline = graph(tmp_path)
    ((use, sink),) = pipeline.sinks
    summary = run(pipeline, Broken(traverse(5)), {use: Path("unused")})
    assert len(sink.values("raised")) == 5
    assert summary["drops"] == {"unreadable": 1}


def test_an_interrupt_finishes_the_frames_in_flight_and_closes_the_sinks(tmp_path):
    stop = Stop()
    pipeline = graph(tmp_path, nap=0.001)
    ((_, sink),) = pipeline.sinks

    def interrupt(whole):
        if len(sink.records) >= 10 and not stop.finishing():
            stop.request()

    _, summary = replayed(pipeline, traverse(10_000), workers=2, stop=stop, on_frame=interrupt)
    assert summary["interrupted"]
    assert summary["verdict"] == "INCOMPLETE"
    assert 10 <= summary["frames_out"] == len(sink.records) < 100
    assert summary["drops"] == {}
    assert sink.summary["frames_out"] == summary["frames_out"]


def test_a_log_that_lacks_what_a_stage_needs_is_refused_with_the_logs_own_words(tmp_path):
    pipeline = graph(tmp_path)
    with pytest.raises(UsageError, match="no level in it"):
        run(pipeline, Log([], missing={"level": "no level in it"}), {})


def test_what_is_optional_is_left_out_where_the_log_lacks_it(tmp_path):
    text = PIPELINE
    for line in ("at: both", "b: height"):
        text = text.replace(line, f"{line}, optional: true")
    pipeline = graph(tmp_path, text=text)
    ((use, sink),) = pipeline.sinks
    summary = run(pipeline, Log(traverse(3), missing={"level": "no level"}), {use: Path("unused")})
    assert summary["verdict"] == "COMPLETE"
    assert "raised" not in sink.streams
    assert len(sink.values("sum")) == 3


def test_inboxes_stay_bounded_when_the_end_of_the_line_is_slow(tmp_path):
    pipeline = graph(tmp_path)
    gate, inside, most = threading.Event(), [], []

    class Slow(Keep):
        def write(self, record):
            gate.wait(5)
            super().write(record)

    sink = Slow()
    engine = Engine(
        pipeline.stages, {"slow": (sink, ["sum"])}, Ledger(), workers=3, capacity=2,
        on_frame=lambda whole: inside.pop(),
    )  # fmt: skip

    def release():
        gate.wait(0.3)
        most.append(len(inside))
        gate.set()

    helper = threading.Thread(target=release)
    helper.start()
    for index in range(60):
        inside.append(index)
        engine.admit(index, {"both": Couple(index, 1.0), "height": Number(index, 0.0)}, [])
    engine.finish()
    helper.join()
    assert most[0] <= 2 * (len(pipeline.stages) + 1) + 3
    assert [record.index for record in sink.records] == list(range(60))


@settings(max_examples=25, deadline=None)
@given(
    workers=st.integers(1, 5),
    capacity=st.integers(1, 3),
    bad=st.sets(st.integers(0, 19), max_size=6),
    seed=st.integers(0, 3),
)
def test_whatever_fails_and_whoever_works_the_result_is_the_same(tmp_path_factory, workers, capacity, bad, seed):
    folder = tmp_path_factory.mktemp("toy")
    sink, summary = replayed(graph(folder, nap=0.0005, bad=[float(b) for b in bad]), traverse(20), workers=workers)
    good = [i for i in range(20) if i not in bad]
    assert list(sink.values("raised")) == [i * 100 * MS for i in good]
    assert list(sink.values("total").values()) == [float(sum(2 * j for j in good if j <= i)) for i in good]
    assert summary["frames_in"] == 20
    assert summary["frames_out"] == len(good)
    assert len(summary["ledger"]) == len(bad)
