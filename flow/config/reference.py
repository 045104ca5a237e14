"""What a pipeline can use: stages, aligners, source and sinks with inputs and parameters, data types with fields."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Iterator
from dataclasses import Field, dataclass, is_dataclass
from enum import IntEnum
from importlib import import_module
from typing import Any

from flow.config.node_spec import MODULES, ROLES, class_at, dataclass_of, lacking, type_name
from flow.contracts import nearest
from flow.errors import UsageError
from flow.parameters import is_required, parameters_of
from flow.runtime.graph import YamlLocation, hints_of, is_aligner, ports_of
from flow.units import as_written


@dataclass(frozen=True)
class ParameterReference:
    """One parameter, its values as a pipeline file writes them.

    name: "rover.max_step" for a key of a mapping; range: the valid values in words, empty where any is valid.
    """

    name: str
    type: str
    meaning: str
    unit: str
    range: str
    default: str


@dataclass(frozen=True)
class NodeReference:
    """A class that a pipeline can use, or a type of its streams.

    role: "stage", "aligner", "source", "sink", "data type" or "codes"; inputs: port -> type; of a data type, field ->
    content; of codes, name -> number.
    """

    use: str
    role: str
    summary: str
    inputs: dict[str, str]
    optional_inputs: tuple[str, ...]
    output: str
    parameters: tuple[ParameterReference, ...]


def stage_reference(name: str | None = None) -> list[NodeReference]:
    """The stages, aligners, source and sinks of the product, or the one called `name`.

    name: as in a pipeline file, "stages.Match", or without its module, "Match"; also a class of the user's own,
    "my_module.Stage", or a data type, "Disparity". Raises UsageError, with the nearest name, if nothing is called so.
    """
    found = {use: kind for module in MODULES for use, kind in _usable(module)}
    if name is None:
        return [_reference(use, kind) for use, kind in found.items()]
    types = {node.use: node for node in data_types()}
    matching = [_reference(use, kind) for use, kind in found.items() if name in (use, use.rpartition(".")[2])]
    if matching or name.removeprefix("stages.") in types:
        return matching or [types[name.removeprefix("stages.")]]
    module = name.rpartition(".")[0]
    if not module or module in MODULES:
        meant = nearest(name, [*found, *(use.rpartition(".")[2] for use in found), *types])
        raise UsageError(f"no stage, aligner, source, sink or data type is called '{name}'{meant}")
    try:
        return [_reference(name, class_at(name, YamlLocation(name, None)))]
    except TypeError as error:
        raise UsageError(str(error)) from error


def data_types() -> list[NodeReference]:
    """The types of streams and of their fields, those that document their own fields and those of codes."""
    module = import_module("stages.data")
    kinds = [getattr(module, name) for name in module.__all__]
    classes = [kind for kind in kinds if isinstance(kind, type)]
    nodes = [_reference(kind.__name__, kind, "codes" if issubclass(kind, IntEnum) else "data type") for kind in classes]
    return [node for node in nodes if node.inputs]


def _usable(module_name: str) -> Iterator[tuple[str, type]]:
    """The classes of a module that can stand under `use`, by that name."""
    module = import_module(module_name)
    for name in getattr(module, "__all__", ()):
        kind = getattr(module, name)
        if isinstance(kind, type) and is_dataclass(kind) and _role(kind) and _is_documented(kind):
            yield f"{module_name}.{name}", kind


def _is_documented(kind: type) -> bool:
    """Whether its fields are parameters: those of a data type are not."""
    return all("help" in known.metadata for known in parameters_of(kind).values())


def _role(kind: type) -> str:
    """What a pipeline can use a class as; empty for a class that it cannot use."""
    if is_aligner(kind):
        return "aligner"
    return next((role for role in ROLES if not lacking(kind, role)), "")


def _reference(use: str, kind: type, role: str = "") -> NodeReference:
    doc, role = inspect.cleandoc(kind.__doc__ or ""), role or _role(kind) or "data type"
    summary = doc.partition("\n\n")[0].replace("\n", " ")
    if role in ("data type", "codes"):
        return NodeReference(use, role, summary, _contents(kind, doc), (), "", ())
    ports, optional = ports_of(kind) if role in ("stage", "aligner") else ({}, set())
    inputs = {port: "any stream" if role == "aligner" else type_name(hint) for port, hint in ports.items()}
    output = type_name(hints_of(kind.__call__).get("return")) if role == "stage" else ""
    return NodeReference(use, role, summary, inputs, tuple(sorted(optional)), output, tuple(_parameters(kind)))


def _contents(kind: type, doc: str) -> dict[str, str]:
    """Field -> content, from the section Parameters of a numpydoc docstring or from the parameters; name -> code."""
    if issubclass(kind, IntEnum):
        return {code.name: str(code.value) for code in kind}
    return _documented_fields(doc) or {
        item.name: f"{item.meaning}{f', {item.unit}' * bool(item.unit)}"
        for item in (_parameters(kind) if is_dataclass(kind) and _is_documented(kind) else ())
    }


def _documented_fields(doc: str) -> dict[str, str]:
    """Field -> type, if the docstring states it, and content, from the section Parameters of a numpydoc docstring."""
    section = re.search(r"(?:Parameters|Attributes)\n-+\n(.*?)(?=\n\n\w+\n-+\n|\Z)", doc, re.S)
    rows = re.findall(r"^(\S.*)\n((?:[ ]+.*\n?)+)", section[1], re.M) if section else []
    named = ((*name.partition(" : "), " ".join(text.split())) for name, text in rows)
    return {name: f"{kind}. {text}" if kind else text for name, _, kind, text in named}


def _parameters(kind: type, prefix: str = "") -> Iterator[ParameterReference]:
    """The parameters of a class, those of a dataclass among them one by one."""
    hints = hints_of(kind)
    for known in parameters_of(kind).values():
        inner = dataclass_of(hints[known.name])
        if inner is not None:
            yield from _parameters(inner, f"{prefix}{known.name}.")
        else:
            yield _parameter(prefix + known.name, hints[known.name], known)


def _parameter(name: str, hint: Any, known: Field[Any]) -> ParameterReference:
    about = known.metadata
    unit = about.get("unit", "")
    return ParameterReference(
        name=name,
        type=type_name(hint),
        meaning=about.get("help", ""),
        unit=unit,
        range=", ".join(map(str, about.get("choices") or ())) or _range(about.get("low"), about.get("high"), unit),
        default="required" if is_required(known) else _written(known.default, unit),
    )


def _range(low: float | None, high: float | None, unit: str) -> str:
    """The valid values in words; empty where any value of the type is valid."""
    least, most = ("" if limit is None else _written(limit, unit) for limit in (low, high))
    if least and most:
        return f"{least.removesuffix(f' {unit}') if most.endswith(f' {unit}') else least} to {most}"
    return f"at least {least}" if least else f"at most {most}" if most else ""


def _written(value: Any, unit: str) -> str:
    """A default or a limit as a pipeline file writes it."""
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "none"}[value]
    if isinstance(value, tuple):
        return f"[{', '.join(_written(item, unit) for item in value)}]"
    if not isinstance(value, int | float):
        return str(value)
    if unit == "rad":
        value = math.radians(float(f"{math.degrees(value):.4g}"))
    text = as_written(value, unit)
    return text if text[-1].isalpha() or not unit or not value else f"{text} {unit}"
