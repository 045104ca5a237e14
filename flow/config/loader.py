"""Pipeline files: YAML in, a checked `Graph` out.

Everything is checked against the stages' own dataclasses and annotations before anything runs. An error names the
file, the line, and the nearest name that would have been valid.
"""

from __future__ import annotations

import sys
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

from flow.config.node_spec import NodeSpec, mapping, place_at_fault, type_name
from flow.config.yaml_tree import Value, nearest, read, settled
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

SHIPPED = Path(__file__).parent.parent / "pipelines"
_BEGIN = f"begin with a copy of {SHIPPED / 'rover.yaml'}, and change its source"


def load(name: str, overrides: Iterable[str] = ()) -> Graph:
    """The pipeline `name`: one that ships with the product, or the path of a YAML file.

    overrides: settings of the command line (see `flow.config.yaml_tree.settled`), applied before anything is checked.
    """
    path = pipeline_file(name)
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise UsageError(f"the pipeline {path} is no text; give {', '.join(shipped())} or a YAML file") from error
    except OSError as error:
        raise UsageError(f"cannot read the pipeline {path}: {error}") from error
    if path.parent != SHIPPED and str(path.parent.resolve()) not in sys.path:
        sys.path.append(str(path.parent.resolve()))  # stages may stand beside the file that uses them
    tree = read(text, lambda line: YamlLocation(path.name, line))
    if tree.value is None:
        raise tree.place.error(f"the file is empty; {_BEGIN}")
    _check_keys(tree)
    return _graph(path, text, settled(tree, overrides))


def pipeline_file(name: str) -> Path:
    """The file of the pipeline `name`, which `load` accepts; a copy of it loads from any folder."""
    if name in shipped():
        return SHIPPED / f"{name}.yaml"
    if Path(name).is_file():
        return Path(name)
    known = shipped()
    raise UsageError(f"no pipeline '{name}': neither a file nor one of {', '.join(known)}{nearest(name, known)}")


def shipped() -> list[str]:
    """The names of the pipelines that ship with the product."""
    return sorted(file.stem for file in SHIPPED.glob("*.yaml"))


def _check_keys(tree: Value) -> None:
    """Refuse what has no such parts, and an unknown one: what it should have been would else be missed elsewhere."""
    valid = ("settings", "source", "streams", "sinks")
    for key, value in mapping(tree, "the pipeline").items():
        if key not in valid:
            raise value.place.error(f"a pipeline has no '{key}'{nearest(key, valid)}")


def _graph(path: Path, text: str, tree: Value) -> Graph:
    """The checked graph of a file's settled tree."""
    top = mapping(tree, "the pipeline")
    for key in ("source", "streams", "sinks"):
        if key not in top:
            raise tree.place.error(f"the pipeline has no '{key}'; {_BEGIN}")
    from_source = NodeSpec.read(top["source"], "the source", "source")
    source = from_source.made()
    streams = mapping(top["streams"], "'streams'")
    if not isinstance(top["sinks"].value, list) or not top["sinks"].value:
        raise top["sinks"].place.error("'sinks' must be a list of at least one sink")
    to_sinks = [NodeSpec.read(item, "a sink", "sink") for item in top["sinks"].value]
    sinks = tuple((entry.use, entry.made()) for entry in to_sinks)
    for entry in to_sinks:
        if [use for use, _ in sinks].count(entry.use) > 1:
            raise entry.place.error(f"{entry.use} stands twice among the sinks")
    kinds: dict[str, type] = dict(source.streams)
    clocks = {name: name for name in kinds}
    for name, item in streams.items():
        _check_name(name, item.place, kinds)
    entries = {name: NodeSpec.read(item, f"stream '{name}'", "stage") for name, item in streams.items()}
    wiring = {name: _inputs(name, entry, [*kinds, *streams]) for name, entry in entries.items()}
    places = {name: item.place for name, item in streams.items()}
    nodes = []
    for name in in_order({n: ports.values() for n, ports in wiring.items()}, places):
        node = _node(name, entries[name], wiring[name], kinds, clocks)
        kinds[name], clocks[name] = node.output, node.clock
        nodes.append(node)
    _check_clock(nodes, top["streams"].place)
    graph = Graph(path.stem, text, source, from_source.use, tuple(nodes), sinks, kinds)
    for (_, sink), entry in zip(sinks, to_sinks, strict=True):
        _check_streams(sink, entry, graph)
    return graph


def _check_name(name: str, place: YamlLocation, of_source: Collection[str]) -> None:
    """Whether a stream may be called so."""
    if not (name.isascii() and name.isidentifier()):
        raise place.error(f"'{name}' is no name of a stream; letters, digits and underscores make one, no digit first")
    if name == "source":
        raise place.error("'source' is no name of a stream: settings of the source go by it")
    if name in of_source:
        raise place.error(f"'{name}' is already a stream of the source; choose another name")


def _inputs(name: str, entry: NodeSpec, streams: list[str]) -> dict[str, str]:
    """Port -> stream, as the entry of stream `name` wires them."""
    try:
        ports, unneeded = ports_of(entry.kind)
    except TypeError as error:
        raise entry.place_of("use").error(str(error)) from error
    parameters, inputs = entry.parameters(), {}
    for key, value in entry.given(but=("optional",)).items():
        if key in ports:
            if not isinstance(value.value, str):
                raise value.place.error(f"'{key}' must be the name of a stream, not {value.plain()!r}")
            if value.value not in streams:
                raise value.place.error(f"there is no stream '{value.value}'{nearest(value.value, streams)}")
            inputs[key] = value.value
        elif key not in parameters:
            valid = [*ports, *parameters, "use", "optional"]
            meant = nearest(key, valid) or f"; it has {', '.join(valid)}"
            raise value.place.error(f"{entry.use} has no input or parameter '{key}'{meant}")
    for port in ports:
        if port not in inputs and port not in unneeded:
            raise entry.place.error(f"'{name}' lacks its input '{port}' ({entry.use} needs it)")
    if is_aligner(entry.kind) and len(set(inputs.values())) < len(inputs):
        twice = f"'{name}' aligns '{next(iter(inputs.values()))}' with itself; name two streams"
        raise place_at_fault([entry.item.value[port] for port in inputs], entry.place).error(twice)
    if not inputs:
        raise entry.place.error(f"'{name}' has no input: give it a stream, for it works once for each item of one")
    return inputs


def _node(name: str, entry: NodeSpec, inputs: dict[str, str], kinds: dict[str, type], clocks: dict[str, str]) -> Node:
    """The node that makes the stream `name`; kinds, clocks: of the streams before it."""
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
    """Whether all stages share one clock, and all alignment comes before them; place: of the streams."""
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
    """Whether the streams that a sink's entry names are there, of the frames, and of types that it can write."""
    keys = set(getattr(sink, "names_streams", ())) & entry.given().keys()
    for key in keys:
        for name in entry.item.value[key].plain():
            if name not in graph.kinds:
                raise entry.place_of(key).error(f"there is no stream '{name}'{nearest(str(name), graph.kinds)}")
            if name not in graph.frame_streams:
                raise entry.place_of(key).error(
                    f"'{name}' is not of the frames, which run on the clock of '{graph.clock}'; align it first "
                    "(flow.align)"
                )
    for name, kind in graph.frame_streams.items() if hasattr(sink, "unwritable") else ():
        if why := sink.unwritable(name, kind):
            named = [key for key in keys if name in entry.item.value[key].plain()]
            raise (entry.place_of(named[0]) if named else entry.place).error(why)
