"""One run: a log through a graph into sinks, with its summary and verdict, whatever happens on the way."""

from __future__ import annotations

import resource
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import FrameType
from typing import Any

from flow.contracts import Event, Log, Sink, Verdict
from flow.errors import PipelineError, SinkError, UsageError
from flow.runtime.engine import Engine
from flow.runtime.findings import NOTE, WARNING, Finding, finding, findings
from flow.runtime.frame_assembler import FrameAssembler
from flow.runtime.graph import Graph
from flow.runtime.ledger import Ledger, failure
from flow.runtime.prepass import surveyed


class Stop:
    """What interrupts ask for: the first to finish the frames in flight, the second to abandon them too."""

    def __init__(self) -> None:
        self._requests = 0
        self.reading = False  # whether the log is being read, where an exception does no harm

    def request(self) -> None:
        """One more interrupt."""
        self._requests += 1

    def finishing(self) -> bool:
        """Whether no new frame shall start."""
        return self._requests >= 1

    def abandoning(self) -> bool:
        """Whether even the frames in flight shall not be waited for."""
        return self._requests >= 2


@contextmanager
def interrupts(stop: Stop, tell: Callable[[str], None]) -> Iterator[None]:
    """Send SIGINT, SIGTERM and SIGHUP to `stop` instead of raising in the middle of something; SIGHUP only where it is
    not ignored, as under nohup."""

    def request(number: int, frame: FrameType | None) -> None:
        stop.request()
        said = "abandoning the frames in flight" if stop.abandoning() else "interrupted: finishing the frames in flight"
        with suppress(Exception):  # a terminal that is gone, or is being written to, must not tear the run
            tell(said)
        if stop.abandoning() and stop.reading:
            raise KeyboardInterrupt  # out of a source that does not answer

    in_main = threading.current_thread() is threading.main_thread()  # only there can signals be caught
    signals = [signal.SIGINT, signal.SIGTERM] if in_main else []
    if in_main and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        signals.append(signal.SIGHUP)
    before = {number: signal.signal(number, request) for number in signals}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@dataclass
class _Outputs:
    """The sinks of a run, each with its path and the streams it is given; and what went wrong with them."""

    sinks: dict[str, tuple[Sink, list[str]]]
    paths: Mapping[str, Path]
    opened: list[str] = field(default_factory=list)
    withheld: list[str] = field(default_factory=list)
    errors: list[tuple[str, BaseException]] = field(default_factory=list)

    def open(self, kinds: Mapping[str, type], about: Mapping[str, str]) -> bool:
        """Open all; False if one could not be."""
        for use, (sink, streams) in self.sinks.items():
            try:
                sink.open(self.paths[use], {stream: kinds[stream] for stream in streams}, about)
            except Exception as error:
                self.errors.append((use, error))
                self.discard()
                return False
            self.opened.append(use)
        return True

    def discard(self, only_empty: bool = False) -> None:
        """Give up what is open, so that an output of an earlier run stays; a sink that cannot is closed later.

        only_empty: of sinks that can tell, those that were given nothing to keep.
        """
        for use in tuple(self.opened):
            sink = self.sinks[use][0]
            discard = getattr(sink, "discard", None)
            if discard is not None and (not only_empty or getattr(sink, "empty", False)):
                self.opened.remove(use)
                self.withheld.append(use)
                with suppress(Exception):  # why it is given up is what to tell of
                    discard()

    def close(self, summary: dict[str, Any]) -> None:
        """Close what is open; raises SinkError if anything went wrong with any sink."""
        for use in self.opened:
            try:
                self.sinks[use][0].close(summary)
            except Exception as error:
                self.errors.append((use, error))
        if self.errors:
            use, cause = self.errors[0]
            if use not in self.paths:  # no output's fault
                raise cause
            failed = {use for use, _ in self.errors}
            kept = "".join(f"; {self.paths[use]} has what came before" for use in self.opened if use not in failed)
            sentence = f"{use.rpartition('.')[2]} could not write {self.paths[use]}: {cause}{kept}"
            raise SinkError(sentence, summary | {"verdict": str(Verdict.INCOMPLETE), "failure": sentence}) from cause


def run(
    graph: Graph,
    log: Log,
    outputs: Mapping[str, Path],
    *,
    workers: int = 2,
    about: Mapping[str, str] | None = None,
    stop: Stop | None = None,
    on_frame: Callable[[bool], None] = lambda whole: None,
) -> dict[str, Any]:
    """Run an opened log through `graph`; returns the summary.

    outputs: sink class, as the pipeline names it -> the path it writes to; sinks without a path stay unused.
    Raises UsageError where the log lacks what the graph needs, SinkError where an output failed; every output is
    closed and readable by then. A run of which no frame gets through leaves no output, and those of an earlier run as
    they are, as far as its sinks can `discard`; so it is with a sink that is `empty` at the end. Of the summary's
    wall_seconds, start_seconds were over before the first frame.
    """
    graph = fitted(graph, log)
    stop, ledger = stop or Stop(), Ledger()
    wall, cpu = time.perf_counter(), time.process_time()
    surveys = dict[str, Finding]()
    with suppress(_StoppedError):
        graph, surveys = surveyed(graph, lambda *which: (_read(part, stop) for part in log.excerpts(*which)))
    streams = graph.frame_streams
    # A sink of the graph is configuration; the copy that is opened belongs to this run.
    used = {use: replace(sink) for use, sink in graph.sinks if use in outputs}
    wanted = {use: [name for name, kind in streams.items() if sink.wants(name, kind)] for use, sink in used.items()}
    sinks = _Outputs({use: (sink, wanted[use]) for use, sink in used.items()}, outputs)
    feeder, started, finished = FrameAssembler(graph, ledger), 0.0, False
    engine = Engine(graph.stages, sinks.sinks, ledger, workers=workers, on_frame=on_frame)
    try:
        said = "\n".join(f"{name}: {found['sentence']}" for name, found in surveys.items())
        if not stop.finishing() and sinks.open(streams, {**(about or {}), "surveys": said}):
            started = time.perf_counter() - wall
            finished = _feed(feeder, _read(log.events(graph.source_streams), stop), engine, stop)
    finally:
        engine.finish(stop.abandoning)
        sinks.errors += [engine.failure] if engine.failure else []
        times = {"wall_seconds": time.perf_counter() - wall, "start_seconds": started}
        times["cpu_seconds"] = time.process_time() - cpu
        whole = finished and engine.whole == engine.admitted and not len(ledger) and not sinks.errors
        sinks.discard(only_empty=engine.through > 0)
        summary = {
            "verdict": str(Verdict.COMPLETE if whole else Verdict.INCOMPLETE),
            "interrupted": stop.finishing(),
            "pipeline": graph.name,
            **_counted(feeder, engine, ledger, times),
            "surveys": surveys,
            "findings": _notes(log, graph) | findings(graph, engine.states),
            "outputs": [str(outputs[use]) for use in sinks.opened],
            "withheld": [str(outputs[use]) for use in sinks.withheld],
        }
        sinks.close(summary)
    return summary


def fitted(graph: Graph, log: Log) -> Graph:
    """The graph without the optional streams that the log lacks; raises UsageError where it lacks another."""
    for why in log.refused.values():
        raise UsageError(why)
    try:
        return graph.without(log.missing)
    except PipelineError as error:
        raise UsageError(str(error)) from None


def _notes(log: Log, graph: Graph) -> dict[str, Finding]:
    """What the log says of the streams that the graph reads."""
    try:
        return {name: finding(NOTE, why) for name, why in log.notes().items() if name in graph.source_streams}
    except Exception as error:  # no reason to leave the outputs open
        return {"log": finding(WARNING, failure(error))}


class _StoppedError(Exception):
    """Leaves the log in the middle; the aligners then draw no conclusion from its end."""


def _feed(feeder: FrameAssembler, events: Iterable[Event], engine: Engine, stop: Stop) -> bool:
    """Admit the frames of the log; False if it was stopped, or an output failed, before the log's end."""
    with suppress(_StoppedError):
        for frame in feeder.frames(events):
            if not engine.admit(frame.stamp, frame.values, frame.entries, stop.finishing):
                feeder.give_back(frame)
                return False
        return True
    return False


def _read(events: Iterable[Event], stop: Stop) -> Iterator[Event]:
    """The events of a log; a source that breaks down ends the log with its exception, and a stop in the middle."""
    log_time, source, broken = 0, iter(events), False
    while not broken:
        try:
            stop.reading = True
            event = next(source)
        except StopIteration:
            return
        except KeyboardInterrupt:
            raise _StoppedError from None
        except Exception as error:  # the rest of the log is lost, what was read of it is not
            event, broken = (log_time, "log", error), True
        finally:
            stop.reading = False
        if stop.finishing() and not broken:
            raise _StoppedError
        log_time = event[0]
        yield event


def _peak_memory_mb() -> float:
    """Largest resident size of this process so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak * (1 if sys.platform == "darwin" else 1024) / 1e6, 1)


def _counted(feeder: FrameAssembler, engine: Engine, ledger: Ledger, times: dict[str, float]) -> dict[str, Any]:
    """Of the summary, what is counted and timed."""
    return {
        "frames_in": engine.admitted,
        "frames_out": engine.whole,
        "frames_through": engine.through,  # whole or not
        "drops": ledger.counts(),
        "messages": dict(sorted(feeder.messages.items())),
        "seconds": {name: round(value, 6) for name, value in engine.seconds.items()},
        **{name: round(value, 6) for name, value in times.items()},
        "frames_per_second": round(engine.whole / times["wall_seconds"], 4),
        "peak_memory_mb": _peak_memory_mb(),
        "ledger": [entry.as_dict() for entry in ledger.entries],
        "entries": [*engine.late_entries, *feeder.late_entries],
    }
