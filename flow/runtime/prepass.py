"""The survey: stages that want to see frames of the whole log before the run are shown some, and then stay fixed.

So a result depends on no order of frames, and on no part of the log that a run is restricted to.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

from flow.contracts import Absent, Event
from flow.runtime.findings import WARNING, Finding, finding, plain
from flow.runtime.frame_assembler import FrameAssembler
from flow.runtime.graph import Graph, Node
from flow.runtime.ledger import Ledger, failure

EXCERPTS = 9

# (how many, of which source streams) -> the stretches of the log
Excerpts = Callable[[int, set[str]], Iterable[Iterable[Event]]]


def surveyed(graph: Graph, excerpts: Excerpts) -> tuple[Graph, dict[str, Finding]]:
    """The graph with its surveying stages fixed, and what each found (stream -> finding).

    A stage surveys if its `surveys` is true; its `survey` takes what `__call__` takes, of several frames each, and
    returns the stage to run and what it found, None if nothing. `excerpts(count, streams)` gives that many stretches
    of the log, spread over all of it; the first whole frame of each is taken. Raises PipelineError where a stage that
    remembers frames is needed for it.
    """
    nodes, findings = list(graph.nodes), dict[str, Finding]()
    if not any(_surveys(node) for node in nodes):
        return graph, findings
    needed = _upstream(nodes)
    samples = _samples(replace(graph, nodes=tuple(node for node in nodes if node.name in needed)), excerpts)
    left = sum(map(_surveys, nodes))
    for place, node in enumerate(nodes):
        if node.aligns or node.name not in needed:
            continue
        if node.stateful:
            raise node.place.error(f"'{node.name}' remembers frames, so nothing that depends on it can survey the log")
        if _surveys(node):
            given = {port: [sample[stream] for sample in samples] for port, stream in node.inputs.items()}
            try:
                actor, said = node.actor.survey(**given)
                if said is not None:
                    findings[node.name] = plain(said)
            except Exception as error:  # the stage then has no more to go by than each frame
                actor = node.actor
                findings[node.name] = finding(WARNING, f"could not survey the log: {failure(error)}")
            nodes[place] = node = replace(node, actor=actor)
            left -= 1
        if left:
            _advance(node, samples)
    return replace(graph, nodes=tuple(nodes)), findings


def _surveys(node: Node) -> bool:
    return bool(getattr(node.actor, "surveys", False))


def _upstream(nodes: Sequence[Node]) -> set[str]:
    """The surveying nodes and all that they depend on."""
    needed = {node.name for node in nodes if _surveys(node)}
    for node in reversed(nodes):  # nodes stand after their inputs
        if node.name in needed:
            needed.update(node.inputs.values())
    return needed


def _samples(graph: Graph, excerpts: Excerpts) -> list[dict[str, Any]]:
    """The streams that no stage makes, of the first whole frame of each excerpt."""
    samples = dict[int, dict[str, Any]]()
    for events in excerpts(EXCERPTS, graph.source_streams):
        for frame in FrameAssembler(graph, Ledger()).frames(events):
            if not any(isinstance(value, Absent) for value in frame.values.values()):
                samples[frame.stamp] = frame.values
                break
    return [samples[stamp] for stamp in sorted(samples)]


def _advance(node: Node, samples: list[dict[str, Any]]) -> None:
    """Add the output of a stage to the samples; one that it fails on is no sample any more."""
    for sample in list(samples):
        try:
            sample[node.name] = node.actor(**{port: sample[stream] for port, stream in node.inputs.items()})
        except Exception:  # the run will meet it again, and enter it in its ledger
            samples.remove(sample)
