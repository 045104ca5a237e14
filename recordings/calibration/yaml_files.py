"""Reads YAML files as calibration tools write them: also OpenCV's, which are not plain YAML."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from recordings.errors import LogError
from stages.data import Array

MAX_FILE_BYTES = 1_000_000


class _RepeatedKey(yaml.MarkedYAMLError):
    """A mapping repeats a key. PyYAML alone would take the last one."""


class _Loader(yaml.SafeLoader):
    """Plain YAML without repeated keys, and OpenCV's matrices."""

    def compose_mapping_node(self, anchor: Any) -> Any:
        node = super().compose_mapping_node(anchor)
        known: set[tuple[str, str]] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode) or key.tag == "tag:yaml.org,2002:merge":
                continue
            if (key.tag, key.value) in known:
                raise _RepeatedKey(problem=f"repeats the key '{key.value}'", problem_mark=key.start_mark)
            known.add((key.tag, key.value))
        return node


def _matrix(loader: _Loader, node: Any) -> Any:
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def read_yaml(path: Path, kind: str = "calibration") -> dict[str, Any]:
    """The mapping in a YAML file. kind: of the file, for the sentence. Raises LogError if there is none."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_FILE_BYTES + 1)
    except (OSError, ValueError) as error:
        raise LogError(f"cannot read the {kind} {path}: {getattr(error, 'strerror', None) or error}") from error
    if len(data) > MAX_FILE_BYTES:
        raise LogError(f"the {kind} {path} has more than {MAX_FILE_BYTES} bytes; give a smaller file")
    try:
        lines = data.decode("utf-8-sig").splitlines()
        # OpenCV begins its files with %YAML:1.0, which is no YAML directive.
        content = yaml.load("\n".join("" if line.startswith("%") else line for line in lines), _Loader)
        values = _count(content, {})
    except Exception as error:  # foreign text may fail the parser in any way
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark is not None else ""
        what = error.problem if isinstance(error, _RepeatedKey) else "cannot be read as YAML"
        raise LogError(f"the {kind} {path}{where} {what}; correct it, or write it again with its tool") from error
    if values > MAX_FILE_BYTES:
        raise LogError(f"the {kind} {path} expands to more than {MAX_FILE_BYTES} values; write it without aliases")
    if not isinstance(content, dict):
        raise LogError(f"the {kind} {path} is not a mapping; write lines of NAME: VALUE")
    return content


def _count(value: Any, counts: dict[int, int]) -> int:
    """The number of values in a value, an alias counted wherever it is used; counts: of the values so far."""
    if not isinstance(value, dict | list):
        return 1
    if id(value) not in counts:
        parts = value.values() if isinstance(value, dict) else value
        counts[id(value)] = 1 + sum(_count(part, counts) for part in parts)
    return counts[id(value)]


def numbers(content: Mapping[str, Any], name: str, shape: tuple[int, ...], where: str) -> Array:
    """The numbers under a name, as a list, nested lists or a mapping with `data`; shape: -1 is any number of them.

    Raises LogError, in which `where` names the file.
    """
    given = content.get(name)
    if isinstance(given, Mapping):
        given = given.get("data")
    if given is None:
        raise LogError(f"{where} lacks '{name}'")
    try:
        found = np.asarray(given, np.float64)
        if -1 not in shape and found.size != int(np.prod(shape)):
            raise ValueError
        found = found.reshape(shape)
    except (ValueError, TypeError, OverflowError) as error:
        count = "x".join("n" if size < 0 else str(size) for size in shape)
        raise LogError(f"'{name}' of {where} is not {count} numbers") from error
    if not np.isfinite(found).all():
        raise LogError(f"'{name}' of {where} contains a number that is not finite")
    return found
