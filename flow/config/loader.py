"""Pipeline files: YAML in, a checked `Graph` out.

The file is read, its settings are filled in and changed, its templates are expanded, and the graph is checked against
the dataclasses and annotations of the stages. An error names the file, the line and the nearest valid name.
"""

from __future__ import annotations

import fnmatch
import os
import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from flow.config.node_spec import OWN_PACKAGES, NodeSpec, mapping, place_at_fault, type_name
from flow.config.overrides import Change, with_settings
from flow.config.templates import SHIPPED, Expansion, Library, Scope, resolved
from flow.config.yaml_tree import Value, nearest_or_all, read
from flow.contracts import as_text, nearest
from flow.errors import UsageError
from flow.runtime.graph import (
    Graph,
    Node,
    YamlLocation,
    accepts,
    clock_of,
    in_order,
    is_aligner,
    output_of,
    ports_of,
    unfit,
)

_KEYS = ("settings", "source", "templates", "streams", "sinks")
_BEGIN = f"begin with a copy of {SHIPPED / 'rover.yaml'}, and change its source"


def load(name: str | Path, overrides: Iterable[str] = (), with_sinks: bool = True) -> Graph:
    """The checked graph of a pipeline.

    Parameters
    ----------
    name
        A pipeline that ships with the product, or the path of a YAML file.
    overrides
        Changes as of `--set`: "setting=value", "stream.parameter=value", "source.parameter=value" or
        "McapSink.parameter=value". The parameter may be a path of keys, as in "source.pitch.sign=-1".
    with_sinks
        Whether the graph has the sinks of the file; some take long to import.

    Raises
    ------
    PipelineError
        If the file does not describe a graph that can run; the sentence contains file and line.
    UsageError
        If there is no such file.
    """
    if isinstance(overrides, str):
        raise UsageError(f"the overrides must be a list of texts, such as ['{overrides}']")
    path = pipeline_file(name)
    text = pipeline_text(path)
    folder = path.parent.resolve() if path.parent != SHIPPED else None
    if folder is not None and str(folder) not in sys.path:
        sys.path.append(str(folder))  # so that stages can be beside the file that uses them
    tree = read(text, lambda line: YamlLocation(path.name, line, folder=folder))
    _check_parts(tree)
    tree, changes = with_settings(tree, map(Change.read, overrides))
    own = mapping(tree.value["templates"], "'templates'") if "templates" in tree.value else {}
    library = Library(own)
    expansion = Expansion(tree.value["streams"].value, library, changes)
    sinks = tree.value["sinks"].value if with_sinks else []
    graph = _graph(as_text(path.stem), text + library.comments(), tree.value, sinks, expansion)
    return replace(graph, changes=tuple(overrides))


def pipeline_text(path: Path) -> str:
    """The text of a pipeline file."""
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        valid = ", ".join(shipped())
        raise UsageError(f"the pipeline {path} is not text in UTF-8; give {valid} or a YAML file") from error
    except OSError as error:
        raise UsageError(f"cannot read the pipeline {path}: {error}") from error


def pipeline_file(name: str | Path, templates: bool = False) -> Path:
    """The file of the pipeline `name`, which `load` accepts; a copy of it loads from any folder.

    templates: whether `name` may also be a template that ships.
    """
    folders = [SHIPPED, SHIPPED / "parts"] if templates else [SHIPPED]
    known = {file.stem: file for folder in folders for file in sorted(folder.glob("*.yaml"))}
    name = str(name)
    if name not in known and not Path(name).is_file():
        what = "pipeline or template" if templates else "pipeline"
        raise UsageError(f"no {what} '{name}': neither a file nor one of {', '.join(known)}{nearest(name, known)}")
    return known.get(name, Path(name))


def modules_beside(file: Path) -> list[Path]:
    """The modules in the folder of a loaded pipeline file, and those of packages there that were imported, sorted."""
    imported = {name.partition(".")[0] for name in sys.modules.copy()} - OWN_PACKAGES
    found = [*file.parent.glob("*.py"), *(module for name in imported for module in (file.parent / name).rglob("*.py"))]
    return sorted(path for path in found if path.stem.isidentifier() and path.is_file() and os.access(path, os.R_OK))


def shipped() -> list[str]:
    """The names of the pipelines that ship with the product."""
    return sorted(file.stem for file in SHIPPED.glob("*.yaml"))


def _check_parts(tree: Value) -> None:
    """Refuse a file with an unknown key (which would otherwise show as a missing one), or without a part."""
    if tree.value is None:
        raise tree.place.error(f"the file is empty; {_BEGIN}")
    for key, value in mapping(tree, "the pipeline").items():
        if key not in _KEYS:
            raise value.place.error(f"a pipeline has no '{key}'{nearest(key, _KEYS)}")
    for key in ("source", "streams", "sinks"):
        if key not in tree.value:
            raise tree.place.error(f"the pipeline has no '{key}'; {_BEGIN}")
    sinks = tree.value["sinks"]
    if not isinstance(sinks.value, list) or not sinks.value:
        raise sinks.place.error("'sinks' must be a list of at least one sink")


def _graph(name: str, text: str, parts: Mapping[str, Value], listed: Sequence[Value], expansion: Expansion) -> Graph:
    """The checked graph of the expanded streams; listed: its sinks."""
    from_source = NodeSpec.read(parts["source"], "the source", "source")
    source = from_source.made()
    to_sinks = [NodeSpec.read(item, "a sink", "sink") for item in listed]
    sinks = tuple((entry.use, entry.made()) for entry in to_sinks)
    for entry in to_sinks:
        if [use for use, _ in sinks].count(entry.use) > 1:
            raise entry.place.error(f"{entry.use} is listed twice under 'sinks'")
    nodes, kinds = _nodes(expansion, dict(source.streams))
    _check_clock(nodes, parts["streams"].place)
    graph = Graph(name, text, source, from_source.use, tuple(nodes), sinks, kinds, templates=expansion.templates)
    for (_, sink), entry in zip(sinks, to_sinks, strict=True):
        _check_streams(sink, entry, graph)
    return graph


def _nodes(expansion: Expansion, kinds: dict[str, type]) -> tuple[list[Node], dict[str, type]]:
    """The nodes in the order of work, and the types of all streams; kinds: those of the source's streams."""
    clocks, streams = {name: name for name in kinds}, expansion.streams
    for name, spec in streams.items():
        if name in kinds:
            raise spec.item.place.error(f"'{name}' is already a stream of the source; choose another name")
    known = [*kinds, *streams]
    for given in expansion.inputs:
        _check_known(given.stream, known, given.place)
    entries = {name: NodeSpec.read(spec.item, f"stream '{name}'", "stage") for name, spec in streams.items()}
    wiring = {name: _inputs(name, entry, known, streams[name].scope) for name, entry in entries.items()}
    places = {name: spec.item.place for name, spec in streams.items()}
    ports = [kind for entry in entries.values() for kind in ports_of(entry.kind)[0].values()]
    types = {name for kind in ports for name in type_name(kind).split(" | ")}
    nodes = []
    for name in in_order({name: ports.values() for name, ports in wiring.items()}, places):
        _check_declared(streams[name].scope, kinds, types)
        node = _node(name, entries[name], wiring[name], kinds, clocks)
        kinds[name], clocks[name] = node.output, node.clock
        nodes.append(node)
    return nodes, kinds


def _check_known(stream: str, known: Collection[str], place: YamlLocation) -> None:
    if stream not in known:
        raise place.error(f"there is no stream '{stream}'{nearest(stream, known)}")


def _check_declared(scope: Scope | None, kinds: Mapping[str, type], types: Collection[str]) -> None:
    """Check the types of the streams given to a template, as far as they are known. types: names of other types."""
    for name, given in (scope.inputs if scope else {}).items():
        kind, wanted = kinds.get(given.stream), str(given.kind.plain())
        if kind is None or wanted in _names(kind):
            continue
        known = {*types, *(name for kind in kinds.values() for name in _names(kind))}
        if wanted not in known:
            raise given.kind.place.error(f"'{name}' has an unknown type, '{wanted}'{nearest(wanted, known)}")
        raise given.place.error(
            f"template '{given.template}' takes {wanted} as '{name}', but '{given.stream}' is {type_name(kind)}"
        )


def _names(kind: type) -> list[str]:
    """The names of a type and its bases."""
    return [base.__name__ for base in getattr(kind, "__mro__", (kind,))]


def _inputs(name: str, entry: NodeSpec, known: list[str], scope: Scope | None) -> dict[str, str]:
    """The stream of each input port of the stream `name`."""
    try:
        ports, unneeded = ports_of(entry.kind)
    except TypeError as error:
        raise entry.place_of("use").error(str(error)) from error
    parameters, inputs = entry.parameters(), {}
    for key, value in entry.given(but=("optional",)).items():
        if key in ports:
            inputs[key] = resolved(key, value, scope)
            _check_known(inputs[key], known, value.place)
        elif key not in parameters:
            valid = [*ports, *parameters, "use", "optional"]
            meant = nearest(key, [*valid, *entry.inner_parameters()]) or nearest_or_all(key, valid)
            raise value.key_place.error(f"{entry.use} has no input or parameter '{key}'{meant}")
    for port in ports:
        if port not in inputs and port not in unneeded:
            raise entry.place.error(f"'{name}' lacks its input '{port}' ({entry.use} needs it)")
    if is_aligner(entry.kind) and len(set(inputs.values())) < len(inputs):
        twice = f"'{name}' aligns '{next(iter(inputs.values()))}' with itself; name two streams"
        raise place_at_fault([entry.item.value[port] for port in inputs], entry.place).error(twice)
    if not inputs:
        raise entry.place.error(f"'{name}' has no input; give it at least one stream")
    return inputs


def _node(name: str, entry: NodeSpec, inputs: dict[str, str], kinds: dict[str, type], clocks: dict[str, str]) -> Node:
    """The node that makes the stream `name`; kinds, clocks: those of the streams before it."""
    actor = entry.made({*inputs, "optional"})
    wanted, _ = ports_of(entry.kind)
    for port, stream in inputs.items():
        if not accepts(wanted[port], kinds[stream]):
            raise entry.place_of(port).error(
                f"{entry.use} takes {type_name(wanted[port])} as '{port}', but '{stream}' is {kinds[stream].__name__}"
            )
    optional = entry.item.value.get("optional", Value(False, entry.place))
    if not isinstance(optional.value, bool):
        raise optional.place.error(f"'optional' must be true or false, not {optional.plain()}")
    if why := unfit(name, actor, inputs):
        raise entry.place.error(why)
    output = output_of(actor, {port: kinds[stream] for port, stream in inputs.items()}, entry.place)
    clock = clock_of(name, actor, {port: clocks[stream] for port, stream in inputs.items()}, entry.place)
    return Node(name, entry.use, actor, inputs, output, clock, optional.value, entry.place)


def _check_clock(nodes: list[Node], place: YamlLocation) -> None:
    """Check that all stages share one clock and that aligners come before them; place: the line of `streams`."""
    stages = [node for node in nodes if not node.aligns]
    if not stages:
        raise place.error("the pipeline has no stage")
    made_by_stages = {node.name for node in stages}
    for node in nodes:
        late = [stream for stream in node.inputs.values() if stream in made_by_stages]
        if node.aligns and late:
            raise node.place.error(f"'{node.name}' aligns '{late[0]}', made by a stage; align before the stages")
        if not node.aligns and node.clock != stages[0].clock:
            raise node.place.error(
                f"'{node.name}' runs on the clock of '{node.clock}', '{stages[0].name}' on that of "
                f"'{stages[0].clock}'; the stages of a pipeline share one clock (align with flow.align)"
            )


def _check_streams(sink: Any, entry: NodeSpec, graph: Graph) -> None:
    """Check that the streams in a sink's entry exist, belong to the frames, and have types that it can write."""
    keys = set(getattr(sink, "names_streams", ())) & entry.given().keys()
    for key in keys:
        for name, place in entry.items_of(key):
            if name not in graph.kinds:
                raise place.error(f"there is no stream '{name}'{nearest(str(name), graph.kinds)}")
            if name not in graph.frame_streams:
                raise place.error(
                    f"'{name}' does not run on the clock of the frames, '{graph.clock}'; align it first (flow.align)"
                )
    for key in set(getattr(sink, "names_patterns", ())) & entry.given().keys():
        for pattern, place in entry.items_of(key):
            if not fnmatch.filter(graph.frame_streams, pattern):
                near = nearest(pattern, graph.frame_streams)
                raise place.error(f"no stream of the frames matches '{pattern}'{near}")
    for name, kind in graph.frame_streams.items() if hasattr(sink, "unwritable") else ():
        if why := sink.unwritable(name, kind):
            named = [place for key in keys for item, place in entry.items_of(key) if item == name]
            raise (named[0] if named else entry.place).error(why)
