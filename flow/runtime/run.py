"""One run: a log through a graph into sinks. A failure still leaves a summary and a verdict."""

from __future__ import annotations

import json
import math
import pickle
import resource
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import islice
from numbers import Integral, Real
from pathlib import Path
from typing import Any, cast

from flow.contracts import MAX_WORKERS, Event, Finding, Log, LossReason, Sink, StageError, Verdict, nearest
from flow.errors import PipelineError, SinkError, UsageError
from flow.runtime.bottleneck import latency, usable_cores
from flow.runtime.checkpoint import Checkpoint, Checkpoints, check_resumable
from flow.runtime.engine import Engine
from flow.runtime.findings import as_dicts, findings, has_fault, warning
from flow.runtime.frame_assembler import FrameAssembler, ReadyFrame, valid_event
from flow.runtime.frame_selection import Every, FrameSelection
from flow.runtime.graph import Graph
from flow.runtime.interrupts import Stop
from flow.runtime.ledger import Ledger, failure
from flow.runtime.pace import Pace
from flow.runtime.prepass import Prepass, prepass


@dataclass
class _Outputs:
    """The sinks of a run. sinks: sink class -> (sink, its streams); paths: sink class -> its file; errors: by sink."""

    sinks: dict[str, tuple[Sink, list[str]]]
    paths: Mapping[str, Path]
    opened: list[str] = field(default_factory=list)
    withheld: list[str] = field(default_factory=list)
    errors: list[tuple[str, BaseException]] = field(default_factory=list)

    @classmethod
    def of(cls, graph: Graph, paths: Mapping[str, Path]) -> _Outputs:
        """The sinks that have a path. A graph's sink is configuration, so each run opens a copy of its own."""
        known = [use for use, _ in graph.sinks]
        for use in (use for use in paths if use not in known):
            raise UsageError(f"the pipeline has no sink '{use}'{nearest(use, known)}")
        sinks = {use: replace(sink) for use, sink in graph.sinks if use in paths}
        kinds = graph.frame_streams.items()
        wanted = {use: [name for name, kind in kinds if sink.wants(name, kind)] for use, sink in sinks.items()}
        for use in (use for use, streams in wanted.items() if not streams):
            naming = "".join(f"name some in its '{key}', or " for key in getattr(sinks[use], "names_streams", ())[-1:])
            raise UsageError(f"{use} writes none of the streams {', '.join(dict(kinds))}; {naming}leave it out")
        return cls({use: (sink, wanted[use]) for use, sink in sinks.items()}, paths)

    def open(self, kinds: Mapping[str, type], about: Mapping[str, str], resumed: Checkpoint | None) -> bool:
        """Open all sinks, to begin or to go on from a checkpoint; False if one fails, and then none stays open."""
        for use, (sink, streams) in self.sinks.items():
            try:
                sink.open(self.paths[use], {stream: kinds[stream] for stream in streams}, about)
                self.opened.append(use)
                if resumed is not None:
                    cast(Any, sink).resume(resumed.state(use))
            except Exception as error:
                self.errors.append((use, error))
                self.discard()
                return False
        return True

    def saved(self) -> dict[str, bytes]:
        """What the sinks have written, for a checkpoint."""
        return {use: pickle.dumps(cast(Any, sink).checkpoint()) for use, (sink, _) in self.sinks.items()}

    def discard(self, only_empty: bool = False) -> None:
        """Discard what is open, so that an existing file stays. A sink without `discard` is closed later instead.

        only_empty: discard only sinks that report to be empty.
        """
        for use in tuple(self.opened):
            sink = self.sinks[use][0]
            discard = getattr(sink, "discard", None)
            if discard is not None and (not only_empty or getattr(sink, "empty", False)):
                self.opened.remove(use)
                self.withheld.append(use)
                with suppress(Exception):  # the reason for discarding is what the run must report
                    discard()

    def close(self, summary: dict[str, Any]) -> None:
        """Close what is open; raises SinkError if any sink has failed."""
        before = "" if not self.errors else " before it"
        for use in self.opened:
            try:
                self.sinks[use][0].close(summary)
            except Exception as error:
                self.errors.append((use, error))
        if self.errors:
            use, cause = self.errors[0]
            if use not in self.paths:  # the error is not one of a sink
                raise cause
            failed = {use for use, _ in self.errors}
            kept = "".join(
                f"; {self.paths[use]} contains the frames{before}" for use in self.opened if use not in failed
            )
            path = self.paths[use]
            named = "" if str(cause).startswith(f"cannot write {path}: ") else f" could not write {path}"
            sentence = f"{use.rpartition('.')[2]}{named}: {cause}{kept}"
            raise SinkError(sentence, summary | {"verdict": str(Verdict.INCOMPLETE), "failure": sentence}) from cause


def run(
    graph: Graph,
    log: Log,
    outputs: Mapping[str, Path],
    *,
    workers: int = 2,
    every: Every | int | None = None,
    rate: float | None = None,
    about: Mapping[str, str] | None = None,
    stop: Stop | None = None,
    on_frame: Callable[[bool], None] = lambda complete: None,
    states: Mapping[str, Any] | None = None,
    checkpoints: Checkpoints | None = None,
) -> dict[str, Any]:
    """Run an opened log through a graph, and return the summary.

    The graph stays as it is: it can be run again, or in several threads at once. If no frame gets through, or a sink is
    `empty` at the end, sinks that can `discard` write nothing and leave existing files alone.

    Parameters
    ----------
    graph
        What `flow.config.loader.load` returns.
    log
        An opened log of the graph's source.
    outputs
        Sink class, as the pipeline names it -> the path it writes to. Sinks without a path are not used.
    workers
        Threads that run the stages.
    every
        The frames to take; the others are left out. Default: all.
    rate
        Pace of the frames, as times of that of their stamps: a frame for which no worker is free until the next one is
        due is dropped. Default: as fast as possible, and no frame is dropped.
    about
        What the sinks record about the run, such as versions.
    stop
        Requests to stop the run early.
    on_frame
        Called after every frame, with whether all of its streams are there.
    states
        Stream -> state that its stage begins with in place of a new one.
    checkpoints
        Where to keep checkpoints, and the one to go on from. Default: none are made.

    Returns
    -------
    dict
        Verdict, counts, times, findings and losses, in plain JSON values; "entries" holds the losses after the last
        frame as objects, for sinks.

    Raises
    ------
    UsageError
        The log lacks a stream that the graph or `every` needs, there is no worker, or a stage or sink has no
        checkpoint.
    SinkError
        An output could not be written. All outputs are closed by then.
    """
    if not isinstance(workers, Integral) or not 1 <= workers <= MAX_WORKERS:
        raise UsageError(f"a run needs 1 to {MAX_WORKERS} workers, not {workers!r}")
    if rate is not None and not (isinstance(rate, Real) and 0 < rate < math.inf):
        raise UsageError(f"the rate of a run must be above 0, not {rate!r}")
    graph = with_spare_threads(asked(fitted(graph, log), outputs), log.frames, workers)
    every = every if isinstance(every, Every) else Every(1 if every is None else every)
    selection = FrameSelection(every, every.odometry(graph.source.streams, log.missing))
    stop, ledger = stop or Stop(), Ledger()
    resumed = checkpoints.last if checkpoints is not None else None
    if checkpoints is not None:
        check_resumable(graph.stages, {use: sink for use, sink in graph.sinks if use in outputs})
    wall, cpu = time.perf_counter(), time.process_time()
    prepared = Prepass(graph)
    with suppress(_StoppedError):
        prepared = prepass(graph, lambda *which: (_read(part, stop, graph) for part in log.excerpts(*which)))
    graph = prepared.graph
    sinks = _Outputs.of(graph, outputs)
    assembler, started, at_end = FrameAssembler(graph, ledger, selection), 0.0, False
    limits = {"workers": workers, "max_frames": workers + 1}
    engine = Engine(graph.stages, sinks.sinks, ledger, **limits, on_frame=on_frame, states=states, resumed=resumed)
    try:
        surveys = "\n".join(f"{name}: {finding.sentence}" for name, finding in prepared.findings.items())
        fixed = "\n".join(f"{name}={json.dumps(value)}" for name, value in prepared.fixed.items())
        given = {"pipeline": graph.text, "overrides": "\n".join(graph.changes), "log": "", **(about or {})}
        facts = {**given, "surveys": surveys, "fixed": fixed}
        if not stop.finishing() and sinks.open(graph.frame_streams, facts, resumed):
            started = time.perf_counter() - wall
            if checkpoints is not None and resumed is not None:  # of the outputs that the run writes from now on
                checkpoints.keep(replace(resumed, states={**resumed.states, **sinks.saved()}))
            events = _read(log.events(assembler.wanted), stop, graph)
            at_end = _feed(assembler.frames(events), assembler, engine, stop, Pace(rate), checkpoints)
    finally:
        engine.finish(stop.abandoning)
        _keep(engine, checkpoints)
        sinks.errors += [engine.failure] if engine.failure else []
        times = {"wall_seconds": time.perf_counter() - wall, "start_seconds": started}
        times |= {"cpu_seconds": time.process_time() - cpu, "survey_cpu_seconds": prepared.cpu_seconds}
        found = _notes(log, graph) | findings(graph, engine.states, prepared.findings)
        faulty = has_fault(found) or has_fault(prepared.findings)
        whole = 0 < engine.admitted == engine.complete and not len(ledger)
        complete = at_end and whole and not faulty and not sinks.errors
        sinks.discard(only_empty=engine.through > 0)
        summary = {
            "verdict": str(Verdict.COMPLETE if complete else Verdict.INCOMPLETE),
            "interrupted": stop.finishing(),
            "pipeline": graph.name,
            "log_begin": getattr(log, "begin", None),
            "first_stamp": getattr(log, "first_stamp", None),
            "every": str(every),
            "frames_left_out": selection.left_out,
            "rate": rate,
            **_counts(assembler, engine, ledger, times),
            "surveys": as_dicts(prepared.findings),
            "fixed": prepared.fixed,
            "findings": as_dicts(found),
            "outputs": [str(outputs[use]) for use in sinks.opened],
            "withheld": [str(outputs[use]) for use in sinks.withheld],
        }
        if rate is not None:  # the pace is the limit
            summary["bottleneck"].pop("another_worker", None)
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


def asked(graph: Graph, outputs: Mapping[str, Path]) -> Graph:
    """The graph whose stages make what its sinks ask for."""
    for use, sink in graph.sinks:
        for name, value in getattr(sink, "asks", {}).items() if use in outputs else ():
            graph = _with_default(graph, name, value)
    return graph


def with_spare_threads(graph: Graph, frames: int | None, workers: int) -> Graph:
    """The graph for a run with two workers for each frame: a stage with `threads` at its default uses two for it."""
    return graph if frames is None or 2 * max(frames, 1) > workers else _with_default(graph, "threads", 2)


def _with_default(graph: Graph, name: str, value: Any) -> Graph:
    """The graph with another value of a parameter in all stages that have it at its default."""
    nodes = {node.name: node for node in graph.nodes}
    for node in graph.stages:
        default = getattr(type(node.actor), name, None)
        if default is not None and getattr(node.actor, name) == default:
            nodes[node.name] = replace(node, actor=replace(node.actor, **{name: value}))
    return replace(graph, nodes=tuple(nodes.values()))


def _notes(log: Log, graph: Graph) -> dict[str, Finding]:
    """The log's notes about the streams that the graph reads, and its faults."""
    try:
        found = {name: Finding(note) for name, note in log.notes().items()}
        found.update(getattr(log, "faults", dict)())
        return {name: finding for name, finding in found.items() if name in graph.source_streams}
    except Exception as error:  # must not leave the outputs open
        return {"log": warning(failure(error))}


class _StoppedError(Exception):
    """Ends the reading of a log before its end, so that aligners do not treat the place as the end of the log."""


def _feed(
    frames: Iterator[ReadyFrame], assembler: FrameAssembler, engine: Engine, stop: Stop, pace: Pace,
    checkpoints: Checkpoints | None,
) -> bool:  # fmt: skip
    """Admit the frames of the log; False if the run was stopped, or an output failed, before the end of the log."""
    begun, paused = time.perf_counter(), 0.0
    try:
        for _ in islice(frames, engine.through):  # before the checkpoint
            engine.report([True])
        begun = time.perf_counter()
        for frame in frames:
            came = time.perf_counter()
            pace.wait(frame.stamp, stop.finishing)
            paused += time.perf_counter() - came
            _keep(engine, checkpoints)
            save = checkpoints is not None and checkpoints.due()
            given = frame.stamp, frame.values, frame.entries
            if not stop.finishing() and engine.admit(*given, stop.finishing, pace.due, pace.deadline, save):
                continue
            if engine.failure or stop.finishing():
                assembler.give_back(frame)
                return False
            assembler.drop(frame, "no worker was free until the next frame was due")
            engine.report([False])
        return True
    except _StoppedError:
        return False
    finally:
        engine.reading = time.perf_counter() - begun - engine.waiting - paused


def _keep(engine: Engine, checkpoints: Checkpoints | None) -> None:
    """Keep the engine's last checkpoint."""
    made = engine.checkpoint
    if checkpoints is not None and made is not None and made is not checkpoints.last:
        checkpoints.keep(made)
    if checkpoints is not None and engine.unsaved:
        checkpoints.give_up(engine.unsaved)


def _read(events: Iterable[Event], stop: Stop, graph: Graph) -> Iterator[Event]:
    """The events of a log until it ends or the run is stopped; an exception of the source becomes the last event."""
    log_time, source, broken = 0, None, False
    while not broken:
        try:
            stop.reading = True
            source = source or iter(events)
            event = valid_event(next(source), graph.source_use, graph.source.streams, log_time)
        except StopIteration:
            return
        except KeyboardInterrupt:
            if not stop.abandoning():  # nobody turns interrupts into requests
                raise
            raise _StoppedError from None
        except Exception as error:  # the rest of the log is lost; the events before it are kept
            mistake = type(error).__module__ == "builtins" and not isinstance(error, OSError)
            event, broken = (log_time, "log", StageError(failure(error)) if mistake else error), True
        finally:
            stop.reading = False
        if stop.finishing() and not broken:
            raise _StoppedError
        log_time = event[0]
        yield event


def _peak_memory_mb() -> float:
    """Largest resident size of this process so far."""
    with suppress(OSError, KeyError):  # ru_maxrss may be that of the process that started this one
        status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
        return round(int(status["VmHWM"].split()[0]) * 1024 / 1e6, 1)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak * (1 if sys.platform == "darwin" else 1024) / 1e6, 1)


def _counts(assembler: FrameAssembler, engine: Engine, ledger: Ledger, times: dict[str, float]) -> dict[str, Any]:
    """The counts and times of the summary. start_seconds is the part of wall_seconds before the first frame."""
    unwritable = (entry for entry in ledger.entries if entry.reason == LossReason.UNWRITABLE)
    return {
        "frames_in": engine.admitted,
        "frames_out": engine.complete,
        "frames_through": engine.through,  # with and without losses
        "frames_resumed": engine.resumed,  # of them, those before the checkpoint that the run went on from
        "drops": ledger.counts(),
        "messages": dict(sorted(assembler.messages.items())),
        "seconds": {name: round(value, 6) for name, value in engine.seconds.items()},
        "cpu_seconds_of": {name: round(value, 6) for name, value in engine.cpu_seconds.items()},
        "reading_seconds": round(engine.reading, 6),
        "latency_seconds": latency(engine.latencies),
        "bottleneck": engine.bottleneck(usable_cores()),
        **{name: round(value, 6) for name, value in times.items()},
        "frames_per_second": round((engine.through - engine.resumed) / times["wall_seconds"], 4),
        "peak_memory_mb": _peak_memory_mb(),
        "ledger": [entry.as_dict() for entry in ledger.entries],
        "entries": [*engine.late_entries, *assembler.late_entries, *unwritable],
    }
