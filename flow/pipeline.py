"""Pipeline files: YAML in, a checked `Graph` out.

Everything is checked against the stages' own dataclasses and annotations before anything runs. An error names the
file, the line, and the nearest name that would have been valid.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, get_args, get_type_hints

import yaml

from flow.errors import PipelineError, UsageError
from flow.graph import Graph, Node, Place, accepts, clock_of, in_order, is_aligner, output_of, ports_of
from flow.ledger import failure
from flow.values import coerced

SHIPPED = Path(__file__).parent / "pipelines"
_RESERVED = ("use", "optional")


@dataclass(frozen=True)
class _Value:
    """A YAML value and where it stands; mappings and sequences hold `_Value`s."""

    value: Any
    place: Place

    def plain(self) -> Any:
        """The value without places."""
        if isinstance(self.value, dict):
            return {key: item.plain() for key, item in self.value.items()}
        if isinstance(self.value, list):
            return [item.plain() for item in self.value]
        return self.value


def load(name: str, overrides: Iterable[str] = ()) -> Graph:
    """The pipeline `name`: one that ships with the product, or the path of a YAML file.

    overrides: "stream.param=value", or "name=value" for one of the file's `settings`, applied before anything is
    checked.
    """
    path = find(name)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"cannot read the pipeline {path}: {error}") from error
    if path.parent != SHIPPED and str(path.parent.resolve()) not in sys.path:
        sys.path.append(str(path.parent.resolve()))  # stages may stand beside the file that uses them
    tree = _parse(text, path.name)
    _check_keys(tree)
    named = set(_texts(tree))
    for setting in overrides:
        _override(tree, setting)
    settled = _settled(tree, _settings(tree))
    for setting, given in _settings(tree).items():
        if f"${setting}" not in named:
            raise given.place.error(f"the setting '{setting}' is used nowhere; write ${setting} where it belongs")
    return _Builder(path, text, settled).graph()


def find(name: str) -> Path:
    """The file of a pipeline."""
    shipped = sorted(file.stem for file in SHIPPED.glob("*.yaml"))
    if name in shipped:
        return SHIPPED / f"{name}.yaml"
    if Path(name).is_file():
        return Path(name)
    raise UsageError(f"no pipeline '{name}': neither a file nor one of {', '.join(shipped)}{_nearest(name, shipped)}")


def _nearest(name: str, valid: Iterable[str]) -> str:
    close = get_close_matches(name, list(valid), n=1, cutoff=0.5)
    return f"; did you mean '{close[0]}'?" if close else ""


def _parse(text: str, file: str) -> _Value:
    try:
        root = yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise Place(file, line).error(f"not valid YAML: {error.problem}") from error
    except yaml.YAMLError as error:
        raise Place(file, 1).error(f"not valid YAML: {error}") from error
    if root is None:
        raise Place(file, 1).error("the file is empty; it needs 'source', 'streams' and 'sinks'")
    try:
        return _located(root, file, yaml.SafeLoader(""))
    except RecursionError:
        raise Place(file, 1).error("a YAML anchor holds itself") from None
    except yaml.MarkedYAMLError as error:
        raise Place(file, error.problem_mark.line + 1 if error.problem_mark else 1).error(str(error.problem)) from error


def _located(node: yaml.Node, file: str, loader: yaml.SafeLoader) -> _Value:
    place = Place(file, node.start_mark.line + 1)
    if isinstance(node, yaml.MappingNode):
        mapping: dict[str, _Value] = {}
        for key_node, value_node in node.value:
            key_place = Place(file, key_node.start_mark.line + 1)
            key = str(loader.construct_object(key_node))
            if key in mapping:
                raise key_place.error(f"'{key}' stands here twice")
            mapping[key] = _Value(_located(value_node, file, loader).value, key_place)
        return _Value(mapping, place)
    if isinstance(node, yaml.SequenceNode):
        return _Value([_located(item, file, loader) for item in node.value], place)
    return _Value(loader.construct_object(node), place)


def _check_keys(tree: _Value) -> None:
    """Refuse an unknown key at the top: what it should have been would else be missed elsewhere first."""
    valid = ("settings", "source", "streams", "sinks")
    for key, value in tree.value.items() if isinstance(tree.value, dict) else ():
        if key not in valid:
            raise value.place.error(f"a pipeline has no '{key}'{_nearest(key, valid)}")


def _override(tree: _Value, setting: str) -> None:
    """Apply one "stream.param=value" ("source.param=value" for the source), or "name=value" of the settings.

    A parameter that is a mapping itself is changed in one place by "stream.param.key=value".
    """
    path, separator, text = setting.partition("=")
    stream, *names = path.strip().split(".")
    if not (separator and stream and all(names)):
        raise UsageError(f"--set {setting}: expected stream.param=value")
    top = tree.value if isinstance(tree.value, dict) else {}
    streams, settings = top["streams"].value if "streams" in top else {}, _settings(tree)
    place = Place(f"--set {setting}", None)
    try:
        node = yaml.compose(text, Loader=yaml.SafeLoader)
        value = None if node is None else _located(node, place.file, yaml.SafeLoader("")).value
    except yaml.YAMLError as error:
        raise UsageError(f"--set {setting}: '{text}' is not valid YAML") from error
    if not names:
        if stream not in settings:
            raise UsageError(f"--set {setting}: the pipeline has no setting '{stream}'{_nearest(stream, settings)}")
        settings[stream] = _Value(value, place)
        return
    targets = {**(streams if isinstance(streams, dict) else {}), "source": top.get("source")}
    if targets.get(stream) is None:
        raise UsageError(f"--set {setting}: there is no stream '{stream}'{_nearest(stream, targets)}")
    item, what = targets[stream], stream
    for depth, name in enumerate(names, 1):
        if not isinstance(item.value, dict):
            raise UsageError(f"--set {setting}: '{what}' is no mapping of names to values")
        if depth == len(names):
            item.value[name] = _Value(value, place)
        else:
            inner = item.value.get(name, _Value({}, place))
            item.value[name] = _Value(inner.value, place)
            item, what = item.value[name], f"{what}.{name}"


def _settings(tree: _Value) -> dict[str, _Value]:
    """The values that a pipeline file names once, to use them in several places."""
    given = tree.value.get("settings") if isinstance(tree.value, dict) else None
    if given is None:
        return {}
    if not isinstance(given.value, dict):
        raise given.place.error("'settings' must be a mapping of names to values")
    return given.value


def _texts(item: _Value) -> list[Any]:
    """All values in `item` that hold no others."""
    if not isinstance(item.value, dict | list):
        return [item.value]
    parts = item.value.values() if isinstance(item.value, dict) else item.value
    return [text for part in parts for text in _texts(part)]


def _settled(item: _Value, settings: Mapping[str, _Value]) -> _Value:
    """The tree `item` with the values of settings where `$name` stands."""
    if isinstance(item.value, dict):
        return _Value({key: _settled(value, settings) for key, value in item.value.items()}, item.place)
    if isinstance(item.value, list):
        return _Value([_settled(value, settings) for value in item.value], item.place)
    if not isinstance(item.value, str) or not item.value.startswith("$"):
        return item
    name = item.value[1:]
    if name not in settings:
        raise item.place.error(f"there is no setting '{name}'{_nearest(name, settings)}")
    return settings[name]


class _Builder:
    """Turns the tree of one file into a graph."""

    def __init__(self, path: Path, text: str, tree: _Value) -> None:
        self.path, self.text, self.tree = path, text, tree

    def graph(self) -> Graph:
        """The checked graph."""
        top = self._mapping(self.tree, "the pipeline")
        for key in ("source", "streams", "sinks"):
            if key not in top:
                raise self.tree.place.error(f"the pipeline has no '{key}'")
        source = self._made(top["source"], "the source")
        streams = self._mapping(top["streams"], "'streams'")
        if not isinstance(top["sinks"].value, list) or not top["sinks"].value:
            raise top["sinks"].place.error("'sinks' must be a list of at least one sink")
        sinks = tuple((self._use(entry, "a sink"), self._made(entry, "a sink")) for entry in top["sinks"].value)
        for entry in top["sinks"].value:
            if [use for use, _ in sinks].count(self._use(entry, "a sink")) > 1:
                raise entry.place.error(f"{self._use(entry, 'a sink')} stands twice among the sinks")
        kinds: dict[str, type] = dict(source.streams)
        clocks = {name: name for name in kinds}
        for name, item in streams.items():
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
        for (_, sink), entry in zip(sinks, top["sinks"].value, strict=True):
            self._check_streams(sink, entry, kinds)
        source_use = self._use(top["source"], "the source")
        return Graph(self.path.stem, self.text, source, source_use, tuple(nodes), sinks, kinds)

    def _node(
        self, name: str, item: _Value, inputs: dict[str, str], kinds: dict[str, type], clocks: dict[str, str]
    ) -> Node:
        actor = self._made(item, f"stream '{name}'", set(inputs))
        wanted, _ = ports_of(type(actor))
        for port, stream in inputs.items():
            if not accepts(wanted[port], kinds[stream]):
                raise item.value[port].place.error(
                    f"{self._use(item, name)} takes a {_shown(wanted[port])} as '{port}', "
                    f"but '{stream}' is a {kinds[stream].__name__}"
                )
        optional = item.value["optional"].value if "optional" in item.value else False
        if not isinstance(optional, bool):
            raise item.place.error(f"'optional' must be true or false, not {item.value['optional'].plain()}")
        output = output_of(actor, {port: kinds[stream] for port, stream in inputs.items()}, item.place)
        clock = clock_of(name, actor, {port: clocks[stream] for port, stream in inputs.items()}, item.place)
        return Node(name, self._use(item, name), actor, inputs, output, clock, optional, item.place)

    @staticmethod
    def _check_streams(sink: Any, entry: _Value, streams: Mapping[str, type]) -> None:
        """Whether the streams that a sink's entry names are there."""
        for key in set(getattr(sink, "names_streams", ())) & entry.value.keys():
            for name in entry.value[key].plain():
                if name not in streams:
                    raise entry.value[key].place.error(f"there is no stream '{name}'{_nearest(str(name), streams)}")

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

    def _inputs(self, name: str, item: _Value, streams: list[str]) -> dict[str, str]:
        """Port -> stream, as the entry of stream `name` wires them."""
        kind = self._class(item, f"stream '{name}'")
        try:
            ports, unneeded = ports_of(kind)
        except (TypeError, NameError) as error:
            raise item.place.error(str(error)) from error
        parameters = _parameters(kind)
        inputs = {}
        for key, value in item.value.items():
            if key in ports:
                if value.value not in streams:
                    raise value.place.error(f"there is no stream '{value.value}'{_nearest(str(value.value), streams)}")
                inputs[key] = value.value
            elif key not in parameters and key not in _RESERVED:
                valid = [*ports, *parameters, *_RESERVED]
                raise value.place.error(
                    f"{self._use(item, name)} has no input or parameter '{key}'"
                    f"{_nearest(key, valid) or '; it has ' + ', '.join(valid)}"
                )
        for port in ports:
            if port not in inputs and port not in unneeded:
                raise item.place.error(f"'{name}' lacks its input '{port}' ({self._use(item, name)} needs it)")
        return inputs

    def _made(self, item: _Value, what: str, skip: set[str] | None = None) -> Any:
        """The object an entry describes; keys in `skip` are inputs, not parameters."""
        kind, parameters, values = self._class(item, what), {}, {}
        parameters = _parameters(kind)
        hints = get_type_hints(kind)
        for key, value in item.value.items():
            if key in _RESERVED or key in (skip or ()):
                continue
            if key not in parameters:
                raise value.place.error(f"{self._use(item, what)} has no parameter '{key}'{_nearest(key, parameters)}")
            try:
                values[key] = coerced(value.plain(), hints[key], parameters[key])
            except ValueError as error:
                raise value.place.error(f"{self._use(item, what)}.{key}: {error}") from error
        for key, parameter in parameters.items():
            if key not in values and parameter.default is MISSING and parameter.default_factory is MISSING:
                raise item.place.error(f"{self._use(item, what)} needs its parameter '{key}'")
        try:
            return kind(**values)
        except Exception as error:  # whatever a stage of the user's own may raise
            by_hand = [item.value[key].place for key in values if item.value[key].place.line is None]
            named = [item.value[key].place for key in values if f"{kind.__name__}.{key}" in str(error)]
            raise (named or by_hand or [item.place])[-1].error(failure(error)) from error

    def _class(self, item: _Value, what: str) -> type:
        use = self._use(item, what)
        place = item.value["use"].place
        module_name, _, name = use.rpartition(".")
        if not module_name:
            raise place.error(f"'use: {use}' must be a module and a class, such as stages.Match")
        try:
            module = importlib.import_module(module_name)
        except Exception as error:  # whatever a module of the user's own may raise
            raise place.error(f"cannot import '{module_name}': {type(error).__name__}: {error}") from error
        kind = getattr(module, name, None)
        if not (isinstance(kind, type) and is_dataclass(kind)):
            listed = [n for n in getattr(module, "__all__", dir(module)) if not n.startswith("_")]
            known = [n for n in listed if is_dataclass(getattr(module, n, None))]
            if hasattr(module, name):
                raise place.error(f"{use} is no dataclass, as what a pipeline uses must be{_nearest(name, known)}")
            raise place.error(f"'{module_name}' has no '{name}' that a pipeline can use{_nearest(name, known)}")
        if (
            what.startswith("stream")
            and not is_aligner(kind)
            and not any("__call__" in vars(base) for base in kind.__mro__)
        ):
            raise place.error(f"{use} is no stage: it has no __call__")
        return kind

    def _use(self, item: _Value, what: str) -> str:
        mapping = self._mapping(item, what)
        if "use" not in mapping:
            raise item.place.error(f"{what} does not say which class to 'use'")
        return str(mapping["use"].value)

    @staticmethod
    def _mapping(item: _Value, what: str) -> dict[str, _Value]:
        if not isinstance(item.value, dict):
            raise item.place.error(f"{what} must be a mapping of names to values")
        return item.value


def _parameters(kind: type) -> dict[str, Field[Any]]:
    return {item.name: item for item in fields(kind) if item.init}


def _shown(kind: Any) -> str:
    """A type as pipeline files speak of it: `Tilt`, or `Tilt | Pose`."""
    if isinstance(kind, type):
        return kind.__name__.replace("NoneType", "None")
    return " | ".join(map(_shown, get_args(kind)))


__all__ = ["PipelineError", "find", "load"]
