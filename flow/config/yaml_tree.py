"""The text of a pipeline file as values that know where they stand, with what the command line sets among them.

A value that several entries share is named once, under `settings`, and stands wherever `$name` does.
"""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import yaml

from flow.errors import UsageError
from flow.runtime.graph import YamlLocation

MOST = 100_000  # values that a pipeline file may hold


@dataclass(frozen=True)
class Value:
    """A YAML value and where it stands; mappings and sequences hold `Value`s."""

    value: Any
    place: YamlLocation

    def plain(self) -> Any:
        """The value without places."""
        if isinstance(self.value, dict):
            return {key: item.plain() for key, item in self.value.items()}
        if isinstance(self.value, list):
            return [item.plain() for item in self.value]
        return self.value


def nearest(name: str, valid: Iterable[str]) -> str:
    """The end of a sentence about a `name` that is none of the valid: which of them may be meant, if any."""
    close = get_close_matches(name, list(valid), n=1)
    return f"; did you mean '{close[0]}'?" if close else ""


def read(text: str, at: Callable[[int], YamlLocation]) -> Value:
    """YAML as values; at: the place of a line of it. Raises PipelineError where it is none."""
    try:
        root = yaml.compose(text, Loader=yaml.SafeLoader)
        if root is not None and _size(root, {}) > MOST:
            raise at(1).error(f"it holds more than {MOST} values, as where YAML aliases hold each other")
        return Value(None, at(1)) if root is None else _located(root, at, yaml.SafeLoader(""))
    except RecursionError:
        raise at(1).error("it is nested too deep, as where a YAML anchor holds itself") from None
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise at(line).error(f"not valid YAML: the character #x{error.character:04x} may not stand there") from error
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise at(line).error(f"not valid YAML: {error.problem}") from error


def _located(node: yaml.Node, at: Callable[[int], YamlLocation], loader: yaml.SafeLoader) -> Value:
    place = at(node.start_mark.line + 1)
    if isinstance(node, yaml.MappingNode):
        mapping: dict[str, Value] = {}
        for key_node, value_node in node.value:
            key, key_place = key_node.value, at(key_node.start_mark.line + 1)
            if key_node.tag != "tag:yaml.org,2002:str":
                shown = f"'{key}'" if isinstance(key, str) else "a list or a mapping"
                raise key_place.error(f"{shown} is no name; names are text, in quotes where YAML reads something else")
            if key in mapping:
                raise key_place.error(f"'{key}' stands here twice")
            mapping[key] = Value(_located(value_node, at, loader).value, key_place)
        return Value(mapping, place)
    if isinstance(node, yaml.SequenceNode):
        return Value([_located(item, at, loader) for item in node.value], place)
    try:
        return Value(loader.construct_object(node), place)
    except (AttributeError, LookupError, ValueError) as error:  # what YAML takes it for by its form, but it is none
        kind = node.tag.rpartition(":")[2]
        raise place.error(f"{reprlib.repr(node.value)} looks like a YAML {kind} but is none; quote it") from error


def _size(node: Any, sizes: dict[int, int]) -> int:
    """How many values a YAML node holds, those of an alias wherever it stands; sizes: of nodes that were seen."""
    if id(node) not in sizes:
        parts = node.value if isinstance(node, yaml.CollectionNode) else ()
        inner = [part for part in parts for part in (part if isinstance(part, tuple) else (part,))]
        sizes[id(node)] = 1 + sum(_size(part, sizes) for part in inner)
    return sizes[id(node)]


def settled(tree: Value, overrides: Iterable[str]) -> Value:
    """The mapping `tree` of a pipeline file, changed as the command line says, with settings where they are named.

    overrides: "stream.param=value" ("source.param=value" for the source), or "name=value" of the settings. What is a
    mapping itself is changed in one place by "stream.param.key=value" or "name.key=value".
    """
    named, settings, entries = set(_texts(tree)), dict(_settings(tree)), _entries(tree)
    of_entries = []
    for names, value in map(_change, overrides):
        name, inner = names[0], names[1:]
        if inner and name in entries:
            of_entries.append((name, inner, value))
        elif name in settings:
            settings[name] = _changed(settings[name], name, inner, value)
        elif inner and name == "settings":
            raise value.place.error(f"settings are set by their names alone, as in {inner[0]}=value")
        elif inner:
            raise value.place.error(f"there is no stream '{name}'{nearest(name, [*entries, *settings])}")
        elif name in entries:
            said = f"say which parameter of '{name}' to set, as in {name}.param=value"
            raise value.place.error(f"{said}{nearest(name, settings)}")
        else:
            raise value.place.error(f"the pipeline has no setting '{name}'{nearest(name, settings)}")
    tree = _filled_in(tree, settings)
    for name, given in _settings(tree).items():
        if any(isinstance(text, str) and text.startswith("$") for text in _texts(settings[name])):
            raise settings[name].place.error(f"the setting '{name}' names another; give it a value of its own")
        if f"${name}" not in named:
            raise given.place.error(f"the setting '{name}' is used nowhere; write ${name} where it belongs")
    for name, inner, value in of_entries:
        among = tree.value if name == "source" else tree.value["streams"].value
        given = _changed(among[name], name, inner, _filled_in(value, settings))
        among[name] = Value(given.value, among[name].place)
    return tree


def _settings(tree: Value) -> dict[str, Value]:
    """The values that a pipeline file names once, to use them in several places."""
    given = tree.value.get("settings")
    if given is None:
        return {}
    if not isinstance(given.value, dict):
        raise given.place.error("'settings' must be a mapping of names to values")
    return given.value


def _entries(tree: Value) -> set[str]:
    """What parameters can be set of: the streams, and the source."""
    streams = tree.value["streams"].value if "streams" in tree.value else {}
    return {*(streams if isinstance(streams, dict) else ()), *({"source"} & tree.value.keys())}


def _change(override: str) -> tuple[list[str], Value]:
    """The names that lead to what a setting on the command line changes, and the value it gives to that."""
    path, separator, text = override.partition("=")
    names = path.strip().split(".")
    if not (separator and all(names)):
        raise UsageError(f"--set {override}: expected stream.param=value, or name=value of the pipeline's settings")
    return names, read(text, lambda line: YamlLocation(f"--set {override}", None))


def _changed(item: Value, what: str, names: Sequence[str], value: Value) -> Value:
    """`item`, which is called `what`, with `value` where `names` lead to, a mapping in a mapping."""
    if not names:
        return value
    if not isinstance(item.value, dict):
        raise value.place.error(f"'{what}' is no mapping of names to values")
    inner = item.value.get(names[0], Value({}, value.place))
    changed = _changed(inner, f"{what}.{names[0]}", names[1:], value)
    return Value({**item.value, names[0]: changed}, value.place)


def _texts(item: Value) -> list[Any]:
    """All values in `item` that hold no others."""
    if not isinstance(item.value, dict | list):
        return [item.value]
    parts = item.value.values() if isinstance(item.value, dict) else item.value
    return [text for part in parts for text in _texts(part)]


def _filled_in(item: Value, settings: Mapping[str, Value]) -> Value:
    """The tree `item` with the values of settings where `$name` stands."""
    if isinstance(item.value, dict):
        return Value({key: _filled_in(value, settings) for key, value in item.value.items()}, item.place)
    if isinstance(item.value, list):
        return Value([_filled_in(value, settings) for value in item.value], item.place)
    if not isinstance(item.value, str) or not item.value.startswith("$"):
        return item
    name = item.value[1:]
    if name not in settings:
        raise item.place.error(f"there is no setting '{name}'{nearest(name, settings)}")
    return settings[name]
