"""Pipeline files: YAML in, a checked `Graph` out.

Everything is checked against the stages' own dataclasses and annotations before anything runs. An error names the
file, the line, and the nearest name that would have been valid.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterable
from dataclasses import MISSING, Field, fields, is_dataclass
from pathlib import Path
from typing import Any, get_args

from flow.document import Value, nearest, read, settled
from flow.errors import UsageError
from flow.graph import Graph, Node, Place, accepts, clock_of, hints_of, in_order, is_aligner, output_of, ports_of, unfit
from flow.ledger import failure
from flow.values import coerced

SHIPPED = Path(__file__).parent / "pipelines"
_BEGIN = f"begin with a copy of {SHIPPED / 'rover.yaml'}, and change its source"
_RESERVED = ("use", "optional")
# what a class needs to have to be one
_NEEDED = {"the source": ("streams", "open"), "a sink": ("suffix", "wants", "open", "write", "close")}


def load(name: str, overrides: Iterable[str] = ()) -> Graph:
    """The pipeline `name`: one that ships with the product, or the path of a YAML file.

    overrides: settings of the command line (see `flow.document.settled`), applied before anything is checked.
    """
    path = _find(name)
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise UsageError(f"the pipeline {path} is no text; give {', '.join(shipped())} or a YAML file") from error
    except OSError as error:
        raise UsageError(f"cannot read the pipeline {path}: {error}") from error
    if path.parent != SHIPPED and str(path.parent.resolve()) not in sys.path:
        sys.path.append(str(path.parent.resolve()))  # stages may stand beside the file that uses them
    tree = read(text, lambda line: Place(path.name, line))
    if tree.value is None:
        raise tree.place.error(f"the file is empty; {_BEGIN}")
    _check_keys(tree)
    return _Builder(path, text, settled(tree, overrides)).graph()


def _find(name: str) -> Path:
    """The file of a pipeline."""
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
    for key, value in _mapping(tree, "the pipeline").items():
        if key not in valid:
            raise value.place.error(f"a pipeline has no '{key}'{nearest(key, valid)}")


class _Builder:
    """Turns the tree of one file into a graph."""

    def __init__(self, path: Path, text: str, tree: Value) -> None:
        self.path, self.text, self.tree = path, text, tree

    def graph(self) -> Graph:
        """The checked graph."""
        top = _mapping(self.tree, "the pipeline")
        for key in ("source", "streams", "sinks"):
            if key not in top:
                raise self.tree.place.error(f"the pipeline has no '{key}'; {_BEGIN}")
        source = self._made(top["source"], "the source")
        streams = _mapping(top["streams"], "'streams'")
        if not isinstance(top["sinks"].value, list) or not top["sinks"].value:
            raise top["sinks"].place.error("'sinks' must be a list of at least one sink")
        sinks = tuple((self._use(entry, "a sink"), self._made(entry, "a sink")) for entry in top["sinks"].value)
        for entry in top["sinks"].value:
            if [use for use, _ in sinks].count(self._use(entry, "a sink")) > 1:
                raise entry.place.error(f"{self._use(entry, 'a sink')} stands twice among the sinks")
        kinds: dict[str, type] = dict(source.streams)
        clocks = {name: name for name in kinds}
        for name, item in streams.items():
            if not (name.isascii() and name.isidentifier()):
                raise item.place.error(
                    f"'{name}' is no name of a stream; letters, digits and underscores make one, no digit first"
                )
            if name == "source":
                raise item.place.error("'source' is no name of a stream: settings of the source go by it")
            if name in kinds:
                raise item.place.error(f"'{name}' is already a stream of the source; choose another name")
        wiring = {name: self._inputs(name, item, [*kinds, *streams]) for name, item in streams.items()}
        places = {name: item.place for name, item in streams.items()}
        nodes = []
        for name in in_order({n: ports.values() for n, ports in wiring.items()}, places):
            node = self._node(name, streams[name], wiring[name], kinds, clocks)
            kinds[name], clocks[name] = node.output, node.clock
            nodes.append(node)
        self._check_clock(nodes)
        source_use = self._use(top["source"], "the source")
        graph = Graph(self.path.stem, self.text, source, source_use, tuple(nodes), sinks, kinds)
        for (_, sink), entry in zip(sinks, top["sinks"].value, strict=True):
            self._check_streams(sink, entry, graph)
        return graph

    def _node(
        self, name: str, item: Value, inputs: dict[str, str], kinds: dict[str, type], clocks: dict[str, str]
    ) -> Node:
        actor = self._made(item, f"stream '{name}'", {*inputs, "optional"})
        wanted, _ = ports_of(type(actor))
        for port, stream in inputs.items():
            if not accepts(wanted[port], kinds[stream]):
                raise item.value[port].place.error(
                    f"{self._use(item, name)} takes {_shown(wanted[port])} as '{port}', "
                    f"but '{stream}' is {kinds[stream].__name__}"
                )
        optional = item.value.get("optional", Value(False, item.place))
        if not isinstance(optional.value, bool):
            raise optional.place.error(f"'optional' must be true or false, not {optional.plain()}")
        if why := unfit(name, actor, inputs):
            raise item.place.error(why)
        output = output_of(actor, {port: kinds[stream] for port, stream in inputs.items()}, item.place)
        clock = clock_of(name, actor, {port: clocks[stream] for port, stream in inputs.items()}, item.place)
        return Node(name, self._use(item, name), actor, inputs, output, clock, optional.value, item.place)

    @staticmethod
    def _check_streams(sink: Any, entry: Value, graph: Graph) -> None:
        """Whether the streams that a sink's entry names are there, and of the frames."""
        for key in set(getattr(sink, "names_streams", ())) & entry.value.keys():
            for name in entry.value[key].plain():
                if name not in graph.kinds:
                    raise entry.value[key].place.error(f"there is no stream '{name}'{nearest(str(name), graph.kinds)}")
                if name not in graph.frame_streams:
                    raise entry.value[key].place.error(
                        f"'{name}' is not of the frames, which run on the clock of '{graph.clock}'; align it first "
                        "(flow.align)"
                    )

    def _check_clock(self, nodes: list[Node]) -> None:
        stages = [node for node in nodes if not node.aligns]
        if not stages:
            raise self.tree.value["streams"].place.error("the pipeline has no stage")
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

    def _inputs(self, name: str, item: Value, streams: list[str]) -> dict[str, str]:
        """Port -> stream, as the entry of stream `name` wires them."""
        kind = self._class(item, f"stream '{name}'")
        try:
            ports, unneeded = ports_of(kind)
        except TypeError as error:
            raise item.value["use"].place.error(str(error)) from error
        parameters = _parameters(kind)
        inputs = {}
        for key, value in item.value.items():
            if key in ports:
                if not isinstance(value.value, str):
                    raise value.place.error(f"'{key}' must be the name of a stream, not {value.plain()!r}")
                if value.value not in streams:
                    raise value.place.error(f"there is no stream '{value.value}'{nearest(value.value, streams)}")
                inputs[key] = value.value
            elif key not in parameters and key not in _RESERVED:
                valid = [*ports, *parameters, *_RESERVED]
                raise value.place.error(
                    f"{self._use(item, name)} has no input or parameter '{key}'"
                    f"{nearest(key, valid) or '; it has ' + ', '.join(valid)}"
                )
        for port in ports:
            if port not in inputs and port not in unneeded:
                raise item.place.error(f"'{name}' lacks its input '{port}' ({self._use(item, name)} needs it)")
        if not inputs:
            raise item.place.error(f"'{name}' has no input: give it a stream, for it works once for each item of one")
        return inputs

    def _made(self, item: Value, what: str, skip: set[str] | None = None) -> Any:
        """The object an entry describes; keys in `skip` are inputs and the like, not parameters."""
        kind, values = self._class(item, what), {}
        parameters = _parameters(kind)
        try:
            hints = hints_of(kind)
        except TypeError as error:
            raise item.value["use"].place.error(str(error)) from error
        for key, value in item.value.items():
            if key == "use" or key in (skip or ()):
                continue
            if key not in parameters:
                raise value.place.error(f"{self._use(item, what)} has no parameter '{key}'{nearest(key, parameters)}")
            try:
                values[key] = coerced(value.plain(), hints[key], parameters[key])
            except (ValueError, OverflowError) as error:
                raise value.place.error(f"{self._use(item, what)}.{key}: {error}") from error
        for key, parameter in parameters.items():
            if key not in values and parameter.default is MISSING and parameter.default_factory is MISSING:
                raise item.place.error(f"{self._use(item, what)} needs its parameter '{key}'")
        try:
            return kind(**values)
        except (Exception, SystemExit) as error:  # whatever a stage of the user's own may raise
            by_hand = [item.value[key].place for key in values if item.value[key].place.line is None]
            named = [item.value[key].place for key in values if f"{kind.__name__}.{key}" in str(error)]
            raise (named or by_hand or [item.place])[-1].error(failure(error)) from error

    def _class(self, item: Value, what: str) -> type:
        use = self._use(item, what)
        place = item.value["use"].place
        module_name, _, name = use.rpartition(".")
        try:
            module = importlib.import_module(module_name)
        except (Exception, SystemExit) as error:  # whatever a module of the user's own may raise
            raise place.error(f"cannot import '{module_name}': {type(error).__name__}: {error}") from error
        kind = getattr(module, name, None)
        if not (isinstance(kind, type) and is_dataclass(kind)):
            listed = [n for n in getattr(module, "__all__", dir(module)) if not n.startswith("_")]
            known = [n for n in listed if is_dataclass(getattr(module, n, None))]
            if hasattr(module, name):
                raise place.error(f"{use} is no dataclass, and a pipeline uses no other class; give it @dataclass")
            raise place.error(f"'{module_name}' has no '{name}' that a pipeline can use{nearest(name, known)}")
        if (
            what.startswith("stream")
            and not is_aligner(kind)
            and not any("__call__" in vars(base) for base in kind.__mro__)
        ):
            raise place.error(f"{use} is no stage: it has no __call__")
        for needed in _NEEDED.get(what, ()):
            if not hasattr(kind, needed):
                raise place.error(f"{use} is no {what.split()[-1]}: it has no '{needed}'")
        return kind

    def _use(self, item: Value, what: str) -> str:
        use = _mapping(item, what).get("use")
        if use is None:
            raise item.place.error(f"{what} does not say which class to 'use'")
        if not isinstance(use.value, str) or not all(use.value.split(".")) or "." not in use.value:
            raise use.place.error(f"'use: {use.plain()}' must be a module and a class, such as stages.Match")
        return use.value


def _mapping(item: Value, what: str) -> dict[str, Value]:
    if not isinstance(item.value, dict):
        raise item.place.error(f"{what} must be a mapping of names to values")
    return item.value


def _parameters(kind: type) -> dict[str, Field[Any]]:
    return {item.name: item for item in fields(kind) if item.init}


def _shown(kind: Any) -> str:
    """A type as pipeline files speak of it: `Tilt`, or `Tilt | Pose`."""
    if isinstance(kind, type):
        return kind.__name__.replace("NoneType", "None")
    return " | ".join(map(_shown, get_args(kind))) or str(kind)
