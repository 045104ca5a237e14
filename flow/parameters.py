"""The parameters of stages, aligners, sources and sinks: their unit, range and choices, and the one check of them.

A parameter is a dataclass field made by `parameter`. `check_parameters` checks the values of an object when it is made.
`coerced` turns a value of a pipeline file, such as `5 ms`, into one of the parameter's type and unit.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, field, fields, is_dataclass
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

from flow.units import as_written, check_bare, quantity

_WORDS = {str: "a text", bool: "true or false", list: "a list", dict: "a mapping", Mapping: "a mapping"}
_PLAIN: dict[str, tuple[Any, str]] = {  # by annotation
    "str": (str, "a text"), "bool": (bool, "true or false"), "tuple[str, ...]": ((tuple, list), "a tuple of texts"),
}  # fmt: skip


def parameter(
    default: Any,
    help: str,
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: Sequence[Any] | None = None,
) -> Any:
    """A dataclass field for a parameter.

    Parameters
    ----------
    default
        The value where none is given; `dataclasses.MISSING` for a required parameter.
    help
        Its meaning, as `roverflow stages` prints it.
    unit
        The unit of a number in the program, such as "m", "rad", "px" or "ns".
    low, high
        The closed range of a number.
    choices
        All valid values, if they are few.
    """
    about = {"help": help, "unit": unit, "low": low, "high": high, "choices": choices}
    return field(default=default, metadata=about)


def set_by_run(default: Any) -> Any:
    """A dataclass field of a sink that a run sets; a pipeline file cannot."""
    return field(default=default, metadata={"set_by_run": True})


def parameters_of(kind: type) -> dict[str, Field[Any]]:
    """The parameters of a dataclass that a pipeline file can set."""
    return {known.name: known for known in fields(kind) if known.init and "set_by_run" not in known.metadata}


def check_parameters(item: Any) -> None:
    """Raise ValueError for the first parameter of a dataclass object that is out of its range or not of its type."""
    for known in fields(item):
        if known.init:
            try:
                _check_plain(getattr(item, known.name), known)
                check(getattr(item, known.name), known)
            except ValueError as error:
                raise ValueError(f"{type(item).__name__}.{known.name} {error}") from None


def _check_plain(value: Any, known: Field[Any]) -> None:
    """Raise ValueError for a value that is no text, truth value or tuple of texts where the parameter is one."""
    kind, wanted = _PLAIN.get(_kind_of(known), (object, ""))
    if not isinstance(value, kind) and (value is not None or known.default is not None):
        raise ValueError(f"must be {wanted}, not {value!r}")


def _kind_of(known: Field[Any]) -> str:
    """The name of the type of a parameter, without None."""
    kind = known.type  # a text in modules with postponed annotations
    return kind.__name__ if isinstance(kind, type) else str(kind).removesuffix(" | None")


class Checked:
    """Base of dataclasses whose parameters are checked when an object is made."""

    def __post_init__(self) -> None:
        check_parameters(self)


def check(value: Any, known: Field[Any], given: Any = None) -> None:
    """Raise ValueError, "must be ...", for a value, or an item of a list, that the parameter `known` does not take.

    given: the value as the user wrote it, for the message.
    """
    if value is None and known.default is None:
        return
    if isinstance(value, tuple | list) and _kind_of(known).startswith(("tuple", "list")):
        for item in value:
            check(item, known)
        return
    low, high, unit, choices = (known.metadata.get(key) for key in ("low", "high", "unit", "choices"))
    shown = _shown(value, unit) if given is None else given
    of_unit = f" in {unit}" if unit and unit != "share" else ""
    if choices is not None and value not in choices:
        raise ValueError(f"must be one of {', '.join(map(str, choices))}, not {shown}")
    if is_dataclass(known.default) and not isinstance(value, type(known.default)):
        raise ValueError(f"must be a {type(known.default).__name__}, not {shown!r}")
    is_whole, is_real = (_kind_of(known) == name for name in ("int", "float"))
    is_number = isinstance(value, numbers.Real) and not isinstance(value, bool)
    if not is_number and (is_whole or is_real or low is not None or high is not None):
        raise ValueError(f"must be a number{of_unit}, not {shown!r}")
    if is_number and not _is_finite(value):
        raise ValueError(f"must be a finite number{of_unit}, not {shown}")
    if is_whole and not isinstance(value, numbers.Integral):
        raise ValueError(f"must be a whole number{of_unit}, not {shown} ({type(value).__name__})")
    if low is not None and value < low:
        raise ValueError(f"must be at least {_limit(low, unit)}, not {shown}")
    if high is not None and value > high:
        raise ValueError(f"must be at most {_limit(high, unit)}, not {shown}")


def _is_finite(value: Any) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number beyond those of floating point
        return False


def coerced(value: Any, kind: Any, known: Field[Any]) -> Any:
    """A value of a pipeline file as the parameter `known` of type `kind`. Raises ValueError for an invalid value."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return None if value is None and NoneType in parts else coerced(value, _option(value, parts), known)
    if origin is Literal and value not in parts:
        raise ValueError(f"must be one of {', '.join(map(str, parts))}, not {value!r}")
    if origin in (tuple, list, Sequence):
        if not isinstance(value, list):
            raise ValueError(f"expected a list, not {value!r}")
        kinds = parts if origin is tuple and parts[-1] is not Ellipsis else parts[:1] * len(value)
        if len(value) != len(kinds):
            raise ValueError(f"expected {len(kinds)} values, not {value!r}")
        items = [coerced(item, part, known) for item, part in zip(value, kinds, strict=True)]
        return items if origin is list else tuple(items)
    if origin in (dict, Mapping) and isinstance(value, dict):
        return {key: coerced(item, parts[1], known) for key, item in value.items()}
    if origin not in (None, dict, Mapping) or kind is Any:
        return value
    if kind in (int, float):
        return _number(value, kind, known)
    plain = origin or kind
    if not isinstance(value, plain):
        wanted = "a mapping" if is_dataclass(plain) else _WORDS.get(plain, plain.__name__)
        raise ValueError(f"expected {wanted}, not {value!r}")
    check(value, known)
    return value


def _option(value: Any, options: Sequence[Any]) -> Any:
    """The type of a union to read a value as: a list as the tuple, anything else as the type that is no tuple."""
    options = [option for option in options if option is not NoneType]
    fitting = [option for option in options if (get_origin(option) is tuple) == isinstance(value, list)]
    return (fitting or options)[0]


def _number(value: Any, kind: type, known: Field[Any]) -> float | int:
    """A number of the pipeline file in the parameter's unit, within its range."""
    unit, given = known.metadata.get("unit", ""), value
    if isinstance(value, str):
        value = quantity(value, unit)
        if kind is int and float(value).is_integer():
            value = int(value)
    elif isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
        check_bare(value, unit)
    if isinstance(value, bool) or not isinstance(value, int if kind is int else (int, float)):
        wanted = {"int": "a whole number", "float": "a number"}[kind.__name__]
        raise ValueError(f"expected {wanted}{f' in {unit}' if unit else ''}, not {given!r}")
    check(value, known, given)
    return kind(value)  # type: ignore[no-any-return]


def _limit(value: float, unit: str | None) -> str:
    """A number with its unit, even where it is 0."""
    text = as_written(value, unit or "")
    return f"{text} {unit or ''}".rstrip() if text[-1].isdigit() else text


def _shown(value: Any, unit: str | None) -> Any:
    """A value as the message about it contains it."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        return value
    try:
        return _limit(float(value), unit)
    except OverflowError:  # a whole number beyond every float
        return value


def is_required(known: Field[Any]) -> bool:
    """Whether a parameter has no default."""
    return known.default is MISSING and known.default_factory is MISSING
