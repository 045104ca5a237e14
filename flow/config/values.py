"""What a value of a pipeline file becomes as a parameter of a stage: of its type, in its unit, within its range."""

from __future__ import annotations

import math
from dataclasses import Field
from types import UnionType
from typing import Any, Union, get_args, get_origin

from flow.config.units import as_written, check_bare, quantity


def coerced(value: Any, kind: Any, parameter: Field[Any]) -> Any:
    """`value` as a parameter of type `kind`; raises ValueError where it is none."""
    if get_origin(kind) in (Union, UnionType):
        options = get_args(kind)
        if value is None and type(None) in options:
            return None
        several = [option for option in options if get_origin(option) is tuple]
        one = [option for option in options if option not in (type(None), *several)]
        return coerced(value, (several if isinstance(value, list) and several else one or several)[0], parameter)
    if get_origin(kind) is tuple:
        if not isinstance(value, list):
            raise ValueError(f"expected a list, not {value!r}")
        return tuple(coerced(item, get_args(kind)[0], parameter) for item in value)
    if get_origin(kind) is not None or kind is Any:
        return value
    if kind in (int, float):
        return _number(value, kind, parameter)
    if not isinstance(value, kind):
        raise ValueError(f"expected {kind.__name__}, not {value!r}")
    return value


def _number(value: Any, kind: type, parameter: Field[Any]) -> float | int:
    unit, given = parameter.metadata.get("unit", ""), value
    if isinstance(value, str):
        value = quantity(value, unit)
        if kind is int and float(value).is_integer():
            value = int(value)
    elif isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
        check_bare(value, unit)
    if isinstance(value, bool) or not isinstance(value, int if kind is int else (int, float)):
        wanted = {"int": "a whole number", "float": "a number"}[kind.__name__]
        raise ValueError(f"expected {wanted}{f' in {unit}' if unit else ''}, not {given!r}")
    low, high = parameter.metadata.get("low"), parameter.metadata.get("high")
    if not math.isfinite(value):
        raise ValueError(f"must be finite, not {given}")
    if low is not None and value < low:
        raise ValueError(f"must be at least {_limit(low, unit)}, not {given}")
    if high is not None and value > high:
        raise ValueError(f"must be at most {_limit(high, unit)}, not {given}")
    return kind(value)  # type: ignore[no-any-return]


def _limit(value: float, unit: str) -> str:
    """A limit with its unit, 0 too."""
    text = as_written(value, unit)
    return text if text[-1].isalpha() else f"{text} {unit}".rstrip()
