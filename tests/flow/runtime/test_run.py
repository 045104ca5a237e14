"""A run ends with a correct verdict and ledger, despite missing streams, failures and interrupts."""

import json
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flow.errors import SinkError, UsageError
from flow.runtime import pace
from flow.runtime.bottleneck import latency
from flow.runtime.engine import Engine
from flow.runtime.interrupts import Stop, interrupts
from flow.runtime.ledger import Ledger
from flow.runtime.run import asked, run, with_spare_threads
from tests.flow.toys import MS, PIPELINE, Couple, Keep, Log, Number, graph, replayed, replayed_log, sink_of, traverse


def test_a_failing_frame_is_recorded_and_the_others_go_on(tmp_path):
    sink, summary = replayed(graph(tmp_path, bad=[3.0, 7.0]), traverse(10), workers=3)
    assert list(sink.values("sum").values()) == [5.0 * i for i in range(10) if i not in (3, 7)]
    assert list(sink.values("thrice").values()) == [3.0 * i for i in range(10)]
    assert summary["verdict"] == "INCOMPLETE"
    assert summary["drops"] == {"failed": 2}
    lost = [(entry["stage"], entry["detail"]) for entry in summary["ledger"]]
    assert lost == [("twice", "cannot scale 3.0"), ("twice", "cannot scale 7.0")]
    assert [r.index for r in sink.records if r.entries] == [3, 7]


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the peak may be that of the process before")
def test_the_peak_memory_is_not_that_of_the_process_that_starts_a_run():
    own = "from flow.runtime.run import _peak_memory_mb as peak; print(peak())"
    large = f"import subprocess, sys; kept = b'1' * 600_000_000; subprocess.run([sys.executable, '-c', {own!r}])"
    said = subprocess.run([sys.executable, "-c", large], capture_output=True, text=True, check=True).stdout
    assert 10 < float(said) < 500


@pytest.mark.parametrize(("frames", "threads"), [(1, 2), (2, 2), (3, 1), (None, 1)])
def test_a_stage_shares_a_frame_among_two_workers_if_there_are_too_few_frames(tmp_path, frames, threads):
    text = PIPELINE.replace("factor: 3 m,", "factor: 3 m, threads: 3,")
    found = {node.name: node.actor for node in with_spare_threads(graph(tmp_path, text=text), frames, 4).nodes}
    assert (found["twice"].threads, found["thrice"].threads) == (threads, 3)
    assert not hasattr(found["sum"], "threads")


def test_a_stage_makes_what_a_sink_of_the_run_asks_for_unless_its_parameter_is_set(tmp_path):
    text = PIPELINE.replace("factor: 3 m,", "factor: 3 m, size: 7 px,")
    pipeline = graph(tmp_path, text=text)
    (use, sink), *_ = pipeline.sinks
    sink.asks = {"size": 2}
    for outputs, sizes in (({use: tmp_path}, (2, 7)), ({}, (1, 7))):
        found = {node.name: node.actor for node in asked(pipeline, outputs).nodes}
        assert (found["twice"].size, found["thrice"].size) == sizes
        assert not hasattr(found["sum"], "size")


def test_an_unreadable_message_and_a_repeated_stamp_are_in_the_ledger(tmp_path):
    events = traverse(4)
    events.insert(3, (10 * MS, "left", OSError("chunk 7 is damaged")))
    events.insert(3, (11 * MS, "left", Number(0, 5.0)))
    events.insert(3, (11 * MS, "left", MemoryError()))
    sink, summary = replayed(graph(tmp_path), events)
    assert summary["drops"] == {"out of order": 1, "unreadable": 2}
    assert "MemoryError" in [entry["detail"] for entry in summary["ledger"]]
    assert len(sink.values("raised")) == 4


@pytest.mark.parametrize(("stage", "why"), [
    ("Liar", "returned Text, not Couple"), ("Late", "returned the stamp 1 ns, not that of its frame"),
])  # fmt: skip
def test_a_result_of_the_wrong_type_or_stamp_fails_the_frame_not_the_run(tmp_path, stage, why):
    text = PIPELINE.replace("tests.flow.toys.Add, a: sum, b: height", f"tests.flow.toys.{stage}, couple: sum")
    _, summary = replayed(graph(tmp_path, text=text), traverse(2))
    assert summary["drops"] == {"failed": 2}
    assert f"tests.flow.toys.{stage} {why}" in summary["ledger"][0]["detail"]


def test_a_failing_sink_stops_the_run_and_is_still_closed(tmp_path):
    pipeline = graph(tmp_path, fail_at=5)
    with pytest.raises(SinkError, match=r"Keep could not write unused: No space left on device"):
        replayed(pipeline, traverse(1000), workers=2)
    assert len(sink_of(pipeline).records) == 5
    assert sink_of(pipeline).summary["verdict"] == "INCOMPLETE"


@dataclass
class FailingClose(Keep):
    """Fails at its end."""

    def close(self, summary: Mapping[str, Any]) -> None:
        """See above."""
        raise OSError("disk full")


class EndsWith(Log):
    """A log that raises an exception after its events."""

    def __init__(self, error, events):
        super().__init__(events)
        self.error = error

    def events(self, streams):
        yield from super().events(streams)
        raise self.error


def test_a_log_that_fails_midway_keeps_the_frames_read_before(tmp_path):
    sink, summary = replayed_log(graph(tmp_path), EndsWith(OSError("input/output error"), traverse(5)))
    assert len(sink.values("raised")) == 5
    assert summary["drops"] == {"unreadable": 1}


def test_a_mistake_in_a_source_is_named_with_its_line(tmp_path):
    _, summary = replayed_log(graph(tmp_path), EndsWith(KeyError("left"), traverse(5)))
    assert "KeyError: 'left' (test_run.py, line" in summary["ledger"][0]["detail"]


def test_stamps_may_be_numbers_of_numpy(tmp_path):
    events = [(np.int64(at), stream, replace(item, stamp=np.int64(item.stamp))) for at, stream, item in traverse(3)]
    _, summary = replayed(graph(tmp_path, bad=[1.0]), events, workers=np.int64(2))
    assert json.loads(json.dumps(summary["ledger"]))[0]["stamp"] == 100 * MS


def test_a_run_without_a_frame_is_not_complete(tmp_path):
    _, summary = replayed(graph(tmp_path), [])
    assert (summary["verdict"], summary["frames_in"], summary["ledger"]) == ("INCOMPLETE", 0, [])


@pytest.mark.parametrize(("event", "why"), [
    (None, "gave an event that is not (log time in whole ns, stream, item)"),
    ((0, "left"), "gave an event that is not"), ((0.5, "left", Number(0, 1.0)), "gave an event that is not"),
    ((0, "lift", Number(0, 1.0)), "declares no stream 'lift'; did you mean 'left'?"),
    ((0, "left", object()), "gave an item whose 'stamp' is not in whole ns"),
    ((0, "left", Number("0", 1.0)), "gave an item whose 'stamp' is not in whole ns"),
])  # fmt: skip
def test_an_event_that_is_none_is_lost_alone(tmp_path, event, why):
    log = Log([])
    log.events = lambda streams: iter([event, *traverse(3)])
    sink, summary = replayed_log(graph(tmp_path), log)
    assert [entry["detail"].partition("Source ")[2][: len(why)] for entry in summary["ledger"]] == [why]
    assert (summary["drops"], len(sink.values("raised"))) == ({"unreadable": 1}, 3)


def test_an_interrupt_that_nobody_takes_for_a_request_ends_the_run(tmp_path):
    pipeline = graph(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        replayed_log(pipeline, EndsWith(KeyboardInterrupt(), traverse(5)))
    assert sink_of(pipeline).summary["verdict"] == "INCOMPLETE"


class Clock:
    """A time that passes only in sleep. start: s after that of the workers."""

    def __init__(self, start):
        self.start = self.now = time.perf_counter() + start

    def perf_counter(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


def test_frames_come_at_the_pace_of_their_stamps(tmp_path, monkeypatch):
    monkeypatch.setattr(pace, "time", clock := Clock(1e6))
    _, summary = replayed(graph(tmp_path), traverse(5), rate=0.5)
    assert clock.now - clock.start == pytest.approx(4 * 0.1 / 0.5)
    assert (summary["verdict"], summary["frames_out"], summary["rate"]) == ("COMPLETE", 5, 0.5)
    assert "another_worker" not in summary["bottleneck"]


def test_a_frame_that_finds_no_worker_until_the_next_one_is_due_is_dropped(tmp_path, monkeypatch):
    monkeypatch.setattr(pace, "time", Clock(-1e6))  # so all deadlines are over
    pipeline, gate, reported = graph(tmp_path), threading.Event(), []

    class Gated(Log):
        def events(self, streams):
            yield from super().events(streams)
            gate.set()

    def write(self, record):
        gate.wait(10)
        kept(self, record)

    kept = Keep.write
    monkeypatch.setattr(Keep, "write", write)
    sink, summary = replayed_log(pipeline, Gated(traverse(6)), workers=2, rate=1.0, on_frame=reported.append)
    kept_frames = len(sink.records)  # two or three are in flight
    assert [record.index for record in sink.records] == list(range(kept_frames))
    assert (summary["verdict"], summary["drops"]) == ("INCOMPLETE", {"dropped": 6 - kept_frames})
    found = [(entry["stamp"], entry["stage"], entry["detail"]) for entry in summary["ledger"]]
    why = "no worker was free until the next frame was due"
    assert found == [(number * 100 * MS, "engine", why) for number in range(kept_frames, 6)]
    assert 2 <= kept_frames <= 3
    assert sorted(reported) == [False] * (6 - kept_frames) + [True] * kept_frames


def test_a_deadline_ends_the_wait_for_room(tmp_path):
    gate = threading.Event()

    class Waiting(Keep):
        def write(self, record):
            gate.wait(10)

    engine = Engine(graph(tmp_path).stages, {"sink": (Waiting(), [])}, Ledger(), workers=1, max_frames=2)
    values, now = {"both": Couple(0, 0.0), "height": Couple(0, 0.0)}, time.perf_counter()
    assert [engine.admit(index, values, [], deadline=now + 0.02) for index in range(3)] == [True, True, False]
    assert engine.waiting >= 0.01
    gate.set()
    engine.finish()


def test_the_losses_of_a_dropped_frame_reach_the_next_one(tmp_path, monkeypatch):
    admit = Engine.admit

    def admitted(self, stamp, *given):
        return stamp != 100 * MS and admit(self, stamp, *given)

    monkeypatch.setattr(Engine, "admit", admitted)
    events = [event for event in traverse(3) if event[:2] != (150 * MS, "level")]
    events.insert(4, (90 * MS, "left", OSError("chunk 7 is damaged")))
    text = PIPELINE.replace("stream: level, at: both", "stream: level, at: both, max_gap: 120 ms")
    sink, summary = replayed(graph(tmp_path, text=text), events, rate=1000.0)
    assert [record.stamp for record in sink.records] == [0, 200 * MS]
    assert summary["drops"]["dropped"] == 1
    details = [entry.detail for entry in sink.records[1].entries]
    assert "chunk 7 is damaged" in details
    assert sum(entry.stamp == 100 * MS for entry in sink.records[1].entries) == 2  # dropped, and without a height


def test_an_interrupt_in_the_wait_for_a_frame_gives_it_back(tmp_path, monkeypatch):
    stop, monkeyed = Stop(), pace.Pace.wait

    def wait(self, stamp, stopped):
        if stamp == 200 * MS:
            stop.request()
        monkeyed(self, stamp, stopped)

    monkeypatch.setattr(pace.Pace, "wait", wait)
    sink, summary = replayed(graph(tmp_path), traverse(5), rate=1000.0, stop=stop)
    assert max(record.stamp for record in sink.records) < 200 * MS
    assert summary["interrupted"]


def test_the_latency_is_that_of_stages_that_do_not_wait_for_the_next_frame(tmp_path, monkeypatch):
    monkeypatch.setattr("random.random", lambda: 1.0)  # whole naps
    _, summary = replayed(graph(tmp_path, nap=0.005), traverse(3))
    assert 0.005 <= summary["latency_seconds"]["median"] <= summary["latency_seconds"]["maximum"]
    assert latency([]) == {}
    assert latency([3.0, 1.0, 2.0]) == {"median": 2.0, "maximum": 3.0}


def test_an_interrupt_finishes_frames_in_flight_and_closes_sinks(tmp_path):
    stop, pipeline = Stop(), graph(tmp_path, nap=0.001)
    sink = sink_of(pipeline)

    def interrupt(whole):
        if len(sink.records) >= 10 and not stop.finishing():
            stop.request()

    _, summary = replayed(pipeline, traverse(10_000), workers=2, stop=stop, on_frame=interrupt)
    assert summary["interrupted"]
    assert summary["verdict"] == "INCOMPLETE"
    assert 10 <= summary["frames_out"] == len(sink.records) < 100
    assert (summary["drops"], summary["ledger"]) == ({}, [])  # unread messages are not lost
    assert sink.summary["frames_out"] == summary["frames_out"]


def test_losses_before_an_interrupt_reach_the_sinks(tmp_path):
    stop, pipeline = Stop(), graph(tmp_path, nap=0.001)

    class Damaged(Log):
        def events(self, streams):
            yield from super().events(streams)
            stop.request()
            yield 1000 * MS, "left", OSError("chunk 7 is damaged")
            yield 1100 * MS, "left", OSError("chunk 8 is damaged")

    damaged = Damaged([*traverse(3), (400 * MS, "left", OSError("chunk 6 is damaged"))])
    sink, summary = replayed_log(pipeline, damaged, stop=stop)
    assert [entry.detail for entry in sink.summary["entries"]] == ["chunk 6 is damaged"]
    assert summary["drops"] == {"unreadable": 1}


def test_a_run_under_nohup_outlives_its_terminal():
    stop, before = Stop(), signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interrupts(stop, print):
            signal.raise_signal(signal.SIGHUP)
        assert not stop.finishing()
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_an_interrupt_after_the_end_of_the_log_loses_no_frame(tmp_path):
    stop, pipeline = Stop(), graph(tmp_path)
    sink = sink_of(pipeline)

    def interrupt(whole):
        if len(sink.records) == 5:
            stop.request()

    _, summary = replayed(pipeline, traverse(5), workers=1, stop=stop, on_frame=interrupt)
    assert (summary["verdict"], summary["interrupted"], summary["frames_out"]) == ("COMPLETE", True, 5)


@pytest.mark.parametrize("discards", [True, False])
def test_a_run_stopped_before_its_first_frame_leaves_no_output(tmp_path, monkeypatch, discards):
    pipeline, stop, gate, given_up = graph(tmp_path), Stop(), threading.Event(), []

    def hang(self, couple):
        stop.request()
        stop.request()
        gate.wait(60)
        return couple

    if discards:
        monkeypatch.setattr(Keep, "discard", lambda self: given_up.append(self), raising=False)
    monkeypatch.setattr("tests.flow.toys.Scale.__call__", hang)
    sink, summary = replayed(pipeline, traverse(3), workers=1, stop=stop)
    gate.set()
    assert summary["frames_out"] == 0
    assert (given_up, summary["outputs"]) == (([sink], []) if discards else ([], ["unused"]))
    assert (sink.summary is None) == discards


def test_a_run_without_a_complete_frame_leaves_no_output(tmp_path, monkeypatch):
    given_up = []
    monkeypatch.setattr(Keep, "discard", lambda self: given_up.append(self), raising=False)
    events = [event for event in traverse(3) if event[1] != "right"]
    sink, summary = replayed(graph(tmp_path), events)
    assert (summary["verdict"], summary["outputs"], given_up) == ("INCOMPLETE", [], [sink])


def test_an_interrupt_message_that_fails_does_not_stop_the_run():
    stop = Stop()

    def gone(sentence):
        raise OSError("Input/output error")  # as of a terminal that was closed

    with interrupts(stop, gone):
        signal.raise_signal(signal.SIGTERM)
        assert (stop.finishing(), stop.abandoning()) == (True, False)
        signal.raise_signal(signal.SIGINT)
        assert stop.abandoning()


def test_a_second_interrupt_does_not_wait_for_a_stage_that_hangs(tmp_path, monkeypatch):
    stop, gate = Stop(), threading.Event()
    pipeline = graph(tmp_path)

    def hang(self, couple):
        if couple.value == 3.0:
            stop.request()
            stop.request()
            gate.wait(60)
        return couple

    monkeypatch.setattr("tests.flow.toys.Scale.__call__", hang)
    sink, summary = replayed(pipeline, traverse(20), workers=1, stop=stop)
    assert not gate.is_set()
    gate.set()
    assert summary["interrupted"]
    assert sink.summary["verdict"] == "INCOMPLETE"
    assert summary["drops"]["abandoned"] == summary["frames_in"] - summary["frames_out"] >= 1
    assert [entry.as_dict() for entry in sink.summary["entries"]] == summary["ledger"]


def test_a_sample_that_cannot_be_made_is_in_the_ledger_and_the_verdict(tmp_path, monkeypatch):
    whole = Number.interpolated

    def broken(earlier, later, stamp):
        if stamp == 200 * MS:
            raise ValueError("no way between them")
        return whole(earlier, later, stamp)

    pipeline = graph(tmp_path)
    monkeypatch.setattr(Number, "interpolated", broken)
    sink, summary = replayed(pipeline, traverse(5))
    assert (summary["verdict"], summary["frames_out"], summary["drops"]) == ("INCOMPLETE", 4, {"failed": 1})
    assert [(entry["stage"], entry["stamp"]) for entry in summary["ledger"]] == [("height", 200 * MS)]
    assert [r.index for r in sink.records if r.entries] == [2]


def test_chained_samplers_answer_to_the_end_of_the_log(tmp_path):
    text = PIPELINE.replace("height: {use: flow.align.interpolate, stream: level, at: both}",
                            "held: {use: flow.align.nearest, stream: level, at: right, slop: 60 ms}\n"
                            "  height: {use: flow.align.nearest, stream: held, at: both, slop: 60 ms}")  # fmt: skip
    _, summary = replayed(graph(tmp_path, text=text), traverse(9))
    assert (summary["verdict"], summary["frames_out"]) == ("COMPLETE", 9)


def test_a_run_that_raises_is_never_marked_complete(tmp_path):
    pipeline = graph(tmp_path)
    with pytest.raises(SystemExit):
        replayed_log(pipeline, EndsWith(SystemExit, traverse(3)))
    assert sink_of(pipeline).summary["verdict"] == "INCOMPLETE"


def test_a_progress_display_that_fails_does_not_stop_the_run(tmp_path):
    def broken(whole):
        raise BrokenPipeError

    sink, summary = replayed(graph(tmp_path), traverse(10), workers=1, on_frame=broken)
    assert summary["frames_out"] == len(sink.records) == 10


def test_patience_runs_on_the_clock_of_the_whole_log(tmp_path):
    events = [(0, "left", Number(0, 1.0))]
    events += [(at, "level", Number(at, 0.0)) for at in range(0, 5000 * MS, 50 * MS)]
    _, summary = replayed(graph(tmp_path), events)
    (entry,) = summary["ledger"]
    assert entry["detail"] == "no partner within 3 s of log time (both.patience)"


def without_level():
    return Log(traverse(3), missing={"level": "no level"})


OPTIONAL_HEIGHT = PIPELINE.replace("at: both}", "at: both, optional: true}")


def test_a_log_without_a_needed_stream_is_refused_with_its_reason(tmp_path):
    with pytest.raises(UsageError, match="no level"):
        replayed_log(graph(tmp_path), without_level())


def test_an_optional_stage_is_left_out_if_the_log_lacks_its_input(tmp_path):
    text = OPTIONAL_HEIGHT.replace("b: height", "b: height, optional: true")
    sink, summary = replayed_log(graph(tmp_path, text=text), without_level())
    assert summary["verdict"] == "COMPLETE"
    assert "raised" not in sink.streams
    assert {"severity": "note", "sentence": "left out: no level"} in summary["findings"].values()
    assert len(sink.values("sum")) == 3


def test_an_optional_port_stays_open_where_the_log_lacks_its_stream(tmp_path):
    text = OPTIONAL_HEIGHT.replace("toys.Add, a: sum, b: h", "toys.Either, a: sum, b: h")
    sink, _ = replayed_log(graph(tmp_path, text=text), without_level())
    assert sink.values("raised") == sink.values("sum")


@pytest.mark.parametrize("optional", ["true", "false"])
def test_a_stage_without_a_needed_input_is_refused_or_left_out(tmp_path, optional):
    either = f"toys.Either, both: true, optional: {optional}, a: sum, b: h"
    pipeline = graph(tmp_path, text=OPTIONAL_HEIGHT.replace("toys.Add, a: sum, b: h", either))
    why = "stream 'raised': Either.both needs a `b`, and no level"
    if optional == "true":
        assert replayed_log(pipeline, without_level())[1]["findings"]["raised"]["sentence"] == f"left out: {why}"
    else:
        with pytest.raises(UsageError, match=why):
            replayed_log(pipeline, without_level())


def test_a_message_that_no_stage_reads_is_no_loss(tmp_path):
    text = "\n".join(line for line in PIPELINE.splitlines() if not re.search("height|raised", line))
    broken = [(50 * MS, "level", OSError("damaged")), (60 * MS, "words", OSError("damaged"))]
    _, summary = replayed(graph(tmp_path, text=text), [*traverse(1), *broken])
    assert (summary["verdict"], summary["ledger"]) == ("COMPLETE", [])


def test_failing_notes_of_a_log_lose_no_output(tmp_path):
    class Mute(Log):
        def notes(self):
            raise OSError("input/output error")

    sink, summary = replayed_log(graph(tmp_path), Mute(traverse(3)))
    assert (sink.summary["verdict"], len(sink.records)) == ("COMPLETE", 3)
    assert summary["findings"]["log"]["severity"] == "warning"
    assert "input/output error" in summary["findings"]["log"]["sentence"]


def test_a_pipeline_whose_streams_are_all_missing_is_refused(tmp_path):
    text = re.sub(r"^(  \w+: +{.*)}$", r"\1, optional: true}", PIPELINE, flags=re.MULTILINE)
    with pytest.raises(UsageError, match="no right camera"):
        replayed_log(graph(tmp_path, text=text), Log([], missing={"right": "no right camera"}))


def test_an_output_that_fails_at_its_end_makes_the_run_incomplete(tmp_path, monkeypatch):
    def full(self, summary):
        raise OSError("No space left on device")

    monkeypatch.setattr(Keep, "close", full)
    with pytest.raises(SinkError, match="No space left") as caught:
        replayed(graph(tmp_path), traverse(3))
    assert caught.value.summary["verdict"] == "INCOMPLETE"


def test_a_failing_close_says_what_the_other_output_contains(tmp_path, monkeypatch):
    text = PIPELINE + "  - {use: tests.flow.runtime.test_run.FailingClose}\n"
    pipeline, paths = graph(tmp_path, text=text), {"tests.flow.toys.Keep": Path("a")}
    paths |= {"tests.flow.runtime.test_run.FailingClose": Path("b")}
    with pytest.raises(SinkError, match=r"could not write b: disk full; a contains the frames$"):
        run(pipeline, Log(traverse(3)), paths)
    with pytest.raises(UsageError, match=r"has no sink 'tests.flow.toys.Kept'; did you mean 'tests.flow.toys.Keep'"):
        run(pipeline, Log(traverse(3)), {"tests.flow.toys.Kept": Path("a")})


@pytest.mark.parametrize(("options", "sentence"), [
    ({"workers": 1.5}, r"a run needs 1 to 1024 workers, not 1\.5"), ({"rate": 0}, "the rate of a run must be above 0"),
    ({"rate": float("nan")}, "the rate of a run must be above 0, not nan"),
    ({"rate": "1"}, "the rate of a run must be above 0, not '1'"), ({"every": 0}, "Every.frames must be at least 1"),
])  # fmt: skip
def test_an_argument_that_is_out_of_range_is_refused(tmp_path, options, sentence):
    with pytest.raises((UsageError, ValueError), match=sentence):
        replayed(graph(tmp_path), traverse(3), **options)


def test_an_unprintable_exception_loses_one_stream_of_its_frame(tmp_path, monkeypatch):
    class UnprintableError(Exception):
        def __str__(self):
            raise RuntimeError("no words for it")

    def fail(self, couple):
        raise UnprintableError

    pipeline = graph(tmp_path)
    monkeypatch.setattr("tests.flow.toys.Scale.__call__", fail)
    _, summary = replayed(pipeline, traverse(3))
    assert summary["drops"] == {"failed": 6}
    assert "UnprintableError: its message cannot be read (test_run.py, line" in summary["ledger"][0]["detail"]
