"""Variants of a pipeline as one graph, in which every stage that they share runs once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from flow.contracts import FrameRecord, Sink
from flow.errors import UsageError
from flow.runtime.graph import Graph, Node


@dataclass(frozen=True)
class Variants:
    """Variants of one pipeline.

    graph: makes the streams of all variants; names: variant -> its stream -> that stream in `graph`; own: variant ->
    its streams that no earlier variant makes.
    """

    graph: Graph
    names: Mapping[str, Mapping[str, str]]
    own: Mapping[str, tuple[str, ...]]


def merged(variants: Mapping[str, Graph]) -> Variants:
    """Join variants of a pipeline to one graph without sinks.

    A stream of the first variant keeps its name. A stream of a later variant is shared if an earlier variant makes it
    by an equal stage from the same streams. Otherwise it is called `stream@variant`.

    Raises
    ------
    UsageError
        If the variants have different sources, whose messages cannot be shared, or pair the images differently.
    """
    (_, first), *_ = variants.items()
    nodes, names, own = dict[str, Node](), dict[str, dict[str, str]](), dict[str, tuple[str, ...]]()
    makers = dict[tuple[str, str, tuple[tuple[str, str], ...]], str]()
    kinds = dict(first.kinds)
    for label, graph in variants.items():
        if repr(graph.source) != repr(first.source):
            raise UsageError("a change of the source needs a run of its own; run both pipelines and use roverflow diff")
        names[label] = mine = dict[str, str]()
        for node in graph.nodes:
            inputs = {port: mine.get(stream, stream) for port, stream in node.inputs.items()}
            maker = (node.use, repr(node.actor), tuple(sorted(inputs.items())))
            if maker not in makers:
                makers[maker] = name = node.name if graph is first else f"{node.name}@{label}"
                clock = mine.get(node.clock, name if node.clock == node.name else node.clock)
                nodes[name] = replace(node, name=name, inputs=inputs, clock=clock)
                kinds[name] = graph.kinds[node.name]
            mine[node.name] = makers[maker]
        if mine.get(graph.clock, graph.clock) != first.clock:
            needs = "needs a run of its own; run both pipelines and use roverflow diff"
            raise UsageError(f"a change of '{graph.clock}', which makes the frames, {needs}")
        own[label] = tuple(name for name, stream in mine.items() if stream.endswith(f"@{label}"))
    return Variants(replace(first, nodes=tuple(nodes.values()), sinks=(), kinds=kinds), names, own)


@dataclass
class VariantSink:
    """Passes the streams of one variant to a sink, under the names that they have in it.

    names: stream of the joined graph -> stream of the variant; about: facts of the variant; first: stamp, ns, of the
    first frame that the sink gets; the earlier ones only give the stages their state.
    """

    sink: Any
    names: Mapping[str, str]
    about: Mapping[str, str]
    first: int

    @property
    def suffix(self) -> str:
        """That of the sink."""
        return str(self.sink.suffix)

    def wants(self, stream: str, kind: type) -> bool:
        """Whether the sink uses a stream of the variant."""
        return stream in self.names and bool(self.sink.wants(self.names[stream], kind))

    def open(self, path: Any, streams: Mapping[str, type], about: Mapping[str, str]) -> None:
        """Begin the output of the variant."""
        self.sink.open(path, {self.names[stream]: kind for stream, kind in streams.items()}, {**about, **self.about})

    def write(self, record: FrameRecord) -> None:
        """Write what the variant has of a frame from `first` on."""
        if record.stamp < self.first:
            return
        items = {self.names[stream]: item for stream, item in record.items.items() if stream in self.names}
        entries = tuple(loss for loss in record.entries if "@" not in loss.stage or loss.stage in self.names)
        unchanged = frozenset(self.names[stream] for stream in record.unchanged if stream in self.names)
        self.sink.write(replace(record, items=items, entries=entries, unchanged=unchanged))

    def close(self, summary: Mapping[str, Any]) -> None:
        """Finish the output of the variant."""
        self.sink.close(summary)


def sink_of(graph: Graph, suffix: str) -> Sink:
    """The sink of a graph that writes such files, as its pipeline sets it; raises UsageError without one."""
    found = next((sink for _, sink in graph.sinks if sink.suffix == suffix), None)
    if found is None:
        raise UsageError(f"the pipeline {graph.name} has no sink that writes {suffix} files; add recordings.McapSink")
    return replace(found)
