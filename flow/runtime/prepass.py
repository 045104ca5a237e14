"""The pre-pass: before a run, a stage may look at frames from the whole log and fix its own parameters.

The run then uses the fixed stage for every frame. So a result depends neither on the order of the frames nor on the
part of the log that is run.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

from flow.contracts import Absent, Event, Finding
from flow.runtime.findings import checked, warning
from flow.runtime.frame_assembler import FrameAssembler
from flow.runtime.graph import Graph, Node
from flow.runtime.ledger import Ledger, failure

EXCERPTS = 7  # stretches of the log, one frame from each

Sample = dict[str, Any]  # stream -> item, of one frame
Excerpts = Callable[[int, set[str]], Iterable[Iterable[Event]]]  # (number, source streams) -> stretches of the log


@dataclass(frozen=True)
class Prepass:
    """A graph ready to run.

    findings: by stream; fixed: "stream.parameter" -> the value that the pre-pass gave it; cpu_seconds: of surveys.
    """

    graph: Graph
    findings: dict[str, Finding] = field(default_factory=dict)
    fixed: dict[str, Any] = field(default_factory=dict)
    cpu_seconds: float = 0.0


def prepass(graph: Graph, excerpts: Excerpts) -> Prepass:
    """Let the surveying stages of a graph see seven frames of the log, and fix them.

    A stage surveys if its `surveys` is true. Its `survey` has the ports of `__call__`, and gets a list for each. It
    returns the stage to run and its finding, or None. Raises PipelineError where a survey depends on a stage with
    state: that stage would have to see every frame.
    """
    surveying = [node.name for node in graph.nodes if _surveys(node)]
    if not surveying:
        return Prepass(graph)
    upstream = graph.upstream_of(surveying)
    needed = upstream.nodes
    for node in needed:
        if node.stateful:
            raise node.place.error(f"'{node.name}' has state, so no stage that depends on it can survey the log")
    samples = _samples(upstream, excerpts)
    nodes = {node.name: node for node in graph.nodes}
    findings, fixed, cpu_seconds = dict[str, Finding](), dict[str, Any](), 0.0
    for node in needed:
        if _surveys(node):
            begun = time.process_time()
            actor, finding = _survey(node, samples)
            cpu_seconds += time.process_time() - begun
            nodes[node.name] = replace(node, actor=actor)
            fixed |= {f"{node.name}.{name}": value for name, value in _changed(node.actor, actor).items()}
            if finding is not None:
                findings[node.name] = finding
        if not node.aligns and any(node.name in other.inputs.values() for other in needed):
            _advance(nodes[node.name], samples)
    return Prepass(replace(graph, nodes=tuple(nodes.values())), findings, fixed, cpu_seconds)


def _survey(node: Node, samples: Sequence[Sample]) -> tuple[Any, Finding | None]:
    """The stage to run in place of a surveying one, and its finding."""
    inputs = {port: [sample[stream] for sample in samples] for port, stream in node.inputs.items()}
    try:
        actor, returned = node.actor.survey(**inputs)
        return actor, checked(returned)
    except Exception as error:  # the stage then works on each frame without the survey
        return node.actor, warning(f"the survey of the log failed: {failure(error)}")


def _changed(before: Any, after: Any) -> dict[str, Any]:
    """The parameters of a stage that a survey changed, as plain JSON values."""
    values = {item.name: getattr(after, item.name) for item in fields(after) if item.init}
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in values.items()
        if value != getattr(before, name, None)
    }


def _surveys(node: Node) -> bool:
    return bool(getattr(node.actor, "surveys", False))


def _samples(graph: Graph, excerpts: Excerpts) -> list[Sample]:
    """The first complete frame of each excerpt, in stamp order, before any stage."""
    samples = dict[int, Sample]()
    for events in excerpts(EXCERPTS, graph.source_streams):
        for frame in FrameAssembler(graph, Ledger()).frames(events):
            if not any(isinstance(value, Absent) for value in frame.values.values()):
                samples[frame.stamp] = frame.values
                break
    return [samples[stamp] for stamp in sorted(samples)]


def _advance(node: Node, samples: list[Sample]) -> None:
    """Add the output of a stage to the samples; drop a sample on which it fails."""
    for sample in list(samples):
        try:
            sample[node.name] = node.actor(**{port: sample[stream] for port, stream in node.inputs.items()})
        except Exception:  # the run meets this frame again, and its ledger reports it
            samples.remove(sample)
