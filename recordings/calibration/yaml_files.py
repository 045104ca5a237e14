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


class _Loader(yaml.SafeLoader):
    """Plain YAML and OpenCV's matrices."""


def _matrix(loader: _Loader, node: Any) -> Any:
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file. Raises LogError if there is none."""
    try:
        size = path.stat().st_size
        if size > MAX_FILE_BYTES:
            raise LogError(f"{path} has {size} bytes, too many for a calibration; give the calibration's file")
        text = path.read_bytes().decode("utf-8-sig")
        lines = text.splitlines()
        # OpenCV begins its files with %YAML:1.0, which is no YAML directive.
        content = yaml.load("\n".join(line for line in lines if not line.startswith("%")), _Loader)
    except OSError as error:
        raise LogError(f"cannot read the calibration {path}: {error.strerror or error}") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark is not None else ""
        raise LogError(
            f"the calibration {path}{where} is not YAML; write it again with the tool it comes from"
        ) from error
    if not isinstance(content, dict):
        raise LogError(f"the calibration {path} contains no names with values; give the calibration's file")
    return content


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
    except (ValueError, TypeError) as error:
        count = "x".join("n" if size < 0 else str(size) for size in shape)
        raise LogError(f"'{name}' of {where} is not {count} numbers") from error
    if not np.isfinite(found).all():
        raise LogError(f"'{name}' of {where} contains a number that is not finite")
    return found
