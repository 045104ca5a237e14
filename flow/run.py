"""One run: a log through a graph into sinks, with its summary and verdict, whatever happens on the way."""

from __future__ import annotations

import resource
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any

from flow.engine import Engine
from flow.errors import PipelineError, SinkError, UsageError
from flow.feeder import Event, Feeder
from flow.graph import Graph
from flow.ledger import Entry, Ledger, Reason, Verdict


class Stop:
    """What an interrupt asks for: the first one to finish the frames in flight, the second to abandon them too."""

    def __init__(self) -> None:
        self._finish, self._abandon = threading.Event(), threading.Event()

    def request(self) -> None:
        """One more interrupt."""
        (self._abandon if self._finish.is_set() else self._finish).set()

    def finishing(self) -> bool:
        """Whether no new frame shall start."""
        return self._finish.is_set()

    def abandoning(self) -> bool:
        """Whether even the frames in flight shall not be waited for."""
        return self._abandon.is_set()


@contextmanager
def interrupts(stop: Stop, tell: Callable[[str], None]) -> Iterator[None]:
    """Send SIGINT and SIGTERM to `stop` instead of raising in the middle of something."""

    def request(number: int, frame: FrameType | None) -> None:
        stop.request()
        tell("abandoning the frames in flight" if stop.abandoning() else "interrupted: finishing the frames in flight")

    signals = (signal.SIGINT, signal.SIGTERM) if threading.current_thread() is threading.main_thread() else ()
    before = {number: signal.signal(number, request) for number in signals}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def run(
    graph: Graph,
    log: Any,
    outputs: Mapping[str, Path],
    *,
    workers: int = 2,
    about: Mapping[str, str] | None = None,
    stop: Stop | None = None,
    on_frame: Callable[[bool], None] = lambda whole: None,
) -> dict[str, Any]:
    """Run an opened log through `graph`; returns the summary.

    log: iterates over (log time, stream, item), has `missing` (stream -> why the log cannot provide it).
    outputs: sink class, as the pipeline names it -> the path it writes to; sinks without a path stay unused.
    Raises UsageError where the log lacks what the graph needs, SinkError where an output failed; every output is
    closed and readable by then.
    """
    try:
        graph = graph.without(log.missing)
    except PipelineError as error:
        raise UsageError(str(error)) from None
    stop = stop or Stop()
    ledger, started = Ledger(), (time.perf_counter(), time.process_time())
    feeder = Feeder(graph, ledger)
    streams = graph.frame_streams
    sinks = {
        use: (sink, [stream for stream, kind in streams.items() if sink.wants(stream, kind)])
        for use, sink in graph.sinks
        if use in outputs
    }
    opened: list[str] = []
    engine: Engine | None = None
    summary: dict[str, Any] = {}
    errors: list[tuple[str, BaseException]] = []
    try:
        for use, (sink, wanted) in sinks.items():
            try:
                sink.open(outputs[use], {stream: streams[stream] for stream in wanted}, dict(about or {}))
            except Exception as error:
                errors.append((use, error))
                break
            opened.append(use)
        else:
            engine = Engine(graph.stages, sinks, ledger, workers=workers, on_frame=on_frame)
            try:
                _feed(feeder, log, engine, stop, ledger)
            finally:
                engine.finish(stop.abandoning)
            if engine.failure:
                errors.append(engine.failure)
    finally:
        wall, cpu = time.perf_counter() - started[0], time.process_time() - started[1]
        summary = _summary(graph, feeder, engine, ledger, stop, wall, cpu)
        for use in opened:
            try:
                sinks[use][0].close(summary)
            except Exception as error:
                errors.append((use, error))
    if errors:
        use, cause = errors[0]
        sentence = f"{use.rpartition('.')[2]} could not write {outputs[use]}: {cause}"
        raise SinkError(sentence, summary | {"verdict": str(Verdict.INCOMPLETE), "failure": sentence}) from cause
    return summary


class _StoppedError(Exception):
    """Leaves the log in the middle; the aligners then draw no conclusion from its end."""


def _feed(feeder: Feeder, log: Any, engine: Engine, stop: Stop, ledger: Ledger) -> None:
    """Admit the frames of the log until it ends, the run is stopped, or an output fails."""

    def events() -> Iterator[Event]:
        log_time = 0
        try:
            for event in log:
                if stop.finishing():
                    raise _StoppedError
                log_time = event[0]
                yield event
        except Exception as error:  # the rest of the log is lost, what was read of it is not
            if isinstance(error, _StoppedError):
                raise
            yield log_time, "log", error

    with suppress(_StoppedError):
        for frame in feeder.frames(events()):
            if not engine.admit(frame.stamp, frame.values, frame.entries, stop.finishing):
                if engine.failure:
                    ledger.add(Entry("frame", frame.stamp, "engine", Reason.ABANDONED, "an output failed before it"))
                return


def _peak_memory_mb() -> float:
    """Largest resident size of this process so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (2**20 if sys.platform == "darwin" else 2**10), 1)


def _summary(
    graph: Graph, feeder: Feeder, engine: Engine | None, ledger: Ledger, stop: Stop, wall: float, cpu: float
) -> dict[str, Any]:
    frames_in = engine.admitted if engine else 0
    frames_out = engine.whole if engine else 0
    whole = engine is not None and not engine.failure and not stop.finishing() and not len(ledger)
    return {
        "verdict": str(Verdict.COMPLETE if whole else Verdict.INCOMPLETE),
        "interrupted": stop.finishing(),
        "pipeline": graph.name,
        "frames_in": frames_in,
        "frames_out": frames_out,
        "drops": ledger.counts(),
        "messages": dict(sorted(feeder.messages.items())),
        "seconds": {name: round(value, 6) for name, value in (engine.seconds if engine else {}).items()},
        "wall_seconds": round(wall, 6),
        "cpu_seconds": round(cpu, 6),
        "frames_per_second": round(frames_out / wall, 4) if wall > 0 else 0.0,
        "peak_memory_mb": _peak_memory_mb(),
        "ledger": [entry.as_dict() for entry in ledger.entries],
        "entries": feeder.late_entries,
    }
