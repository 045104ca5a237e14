"""The text of a pipeline file as values with their lines."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import yaml

from flow.contracts import nearest
from flow.runtime.graph import YamlLocation

MAX_TEXT, MAX_VALUES = 200_000, 100_000  # characters and values of a pipeline file


@dataclass(frozen=True)
class Value:
    """A YAML value and its place; mappings and sequences contain `Value`s.

    filled_at: the place of the `$name` that the value of a setting or a parameter was filled in for.
    """

    value: Any
    place: YamlLocation
    filled_at: YamlLocation | None = None

    @property
    def key_place(self) -> YamlLocation:
        """The place of the key with this value."""
        return self.filled_at or self.place

    def leaves(self) -> Iterator[Value]:
        """The values in it that contain no others."""
        parts = self.value.values() if isinstance(self.value, dict) else self.value
        if isinstance(self.value, dict | list):
            yield from (leaf for part in parts for leaf in part.leaves())
        else:
            yield self

    def plain(self) -> Any:
        """The value without places."""
        if isinstance(self.value, dict):
            return {key: item.plain() for key, item in self.value.items()}
        if isinstance(self.value, list):
            return [item.plain() for item in self.value]
        return self.value


def nearest_or_all(name: str, valid: Sequence[str]) -> str:
    """As `nearest`, or where none is near, all valid names."""
    return nearest(name, valid) or (f"; it has {', '.join(valid)}" if valid else "")


def read(text: str, at: Callable[[int], YamlLocation]) -> Value:
    """YAML as values; at: the place of a line. Raises PipelineError for invalid YAML."""
    if len(text) > MAX_TEXT:
        raise at(1).error(f"too large for a pipeline file (limit: {MAX_TEXT} characters)")
    try:
        root = yaml.compose(text, Loader=yaml.SafeLoader)
        if root is not None and _size(root, {}) > MAX_VALUES:
            raise at(1).error(f"too large after expanding YAML aliases (limit: {MAX_VALUES} values)")
        return Value(None, at(1)) if root is None else _located(root, at, yaml.SafeLoader(""))
    except RecursionError:
        raise at(1).error("nested too deep; does a YAML anchor contain itself?") from None
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise at(line).error(f"not valid YAML: the character #x{error.character:04x} is not allowed") from error
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        begun = f", {error.context} from line {error.context_mark.line + 1} on" if error.context_mark else ""
        form = isinstance(error, yaml.scanner.ScannerError | yaml.parser.ParserError)
        remedy = "; check indentation (spaces, no tabs), brackets and quotes up to here" if form else ""
        raise at(line).error(f"not valid YAML: {error.problem}{begun}{remedy}") from error


def _located(node: yaml.Node, at: Callable[[int], YamlLocation], loader: yaml.SafeLoader) -> Value:
    place = at(node.start_mark.line + 1)
    if isinstance(node, yaml.MappingNode):
        mapping: dict[str, Value] = {}
        for key_node, value_node in node.value:
            key, key_place = key_node.value, at(key_node.start_mark.line + 1)
            if key_node.tag != "tag:yaml.org,2002:str":
                shown = f"'{key}'" if isinstance(key, str) else "a list or a mapping"
                raise key_place.error(f"{shown} is not a name; write text, quoted where YAML reads something else")
            if key in mapping:
                raise key_place.error(f"'{key}' is here twice")
            mapping[key] = Value(_located(value_node, at, loader).value, key_place)
        return Value(mapping, place)
    if isinstance(node, yaml.SequenceNode):
        return Value([_located(item, at, loader) for item in node.value], place)
    kind, text = node.tag.rpartition(":")[2], node.value
    if (kind == "int" and re.match(r"[-+]?0[\d_bx]", text)) or (kind in ("int", "float") and ":" in text):
        other = "an octal, hexadecimal, binary or base-60 number"
        raise place.error(f"YAML reads {reprlib.repr(text)} as {other}; write a decimal one without leading zeros")
    try:
        return Value(loader.construct_object(node), place)
    except (AttributeError, LookupError, ValueError) as error:  # in the form of a type, but no such value
        raise place.error(f"{reprlib.repr(text)} looks like a YAML {kind} but is none; quote it") from error


def _size(node: Any, sizes: dict[int, int]) -> int:
    """The number of values in a YAML node, an alias counted wherever it is used; sizes: of the nodes so far."""
    if id(node) not in sizes:
        parts = node.value if isinstance(node, yaml.CollectionNode) else ()
        inner = [part for part in parts for part in (part if isinstance(part, tuple) else (part,))]
        sizes[id(node)] = 1 + sum(_size(part, sizes) for part in inner)
    return sizes[id(node)]
