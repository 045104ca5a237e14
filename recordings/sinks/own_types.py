"""Streams of any type, taken apart: numbers, texts, arrays and known types, each under its path.

A stage may return an image, a number, a str, a table of numbers or a dataclass of these. Both sinks take such a value
apart by `leaves`; `refusal` reports, before a run, the part that has no standard form.
"""

from __future__ import annotations

import numbers
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import lru_cache
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from flow.contracts import unaliased

NUMBERS = (numbers.Real, np.bool_)  # of Python and numpy; bool is one of them
_HEADER_FIELDS = ("stamp", "frame_id")  # fields that go into the header of a message

Leaf = tuple[tuple[str, ...], Any]


def plain_type(kind: Any) -> Any:
    """The class of an annotation: `numpy.ndarray` for `NDArray[numpy.uint8]`, `dict` for `dict[str, float]`."""
    return get_origin(kind) or kind


def leaves(value: Any, kind: Any, known: tuple[type, ...] = ()) -> Iterator[Leaf]:
    """The parts of a value, each with its path: bool, int, float, str, arrays, and items of the types `known`.

    kind: the annotated type, which makes an int a float where a float is declared. None has no part. A part of any
    other type is returned as it is.
    """
    if value is None:
        return
    if isinstance(value, (*known, str)):
        yield (), value
    elif isinstance(value, NUMBERS) or (np.shape(value) == () and isinstance(value, np.ndarray)):
        yield (), _number(value[()] if isinstance(value, np.ndarray) else value, kind)
    elif isinstance(value, Mapping):
        inner = (get_args(kind) or (str, float))[-1]
        for key, item in value.items():
            yield from _below(str(key), item, inner, known)
    elif isinstance(value, tuple | list):
        yield (), _array(value, kind)
    elif is_dataclass(value) and not isinstance(value, type):
        for name, inner in field_types(type(value)).items():
            yield from _below(name, getattr(value, name), inner, known)
    else:
        yield (), value


def _below(name: str, value: Any, kind: Any, known: tuple[type, ...]) -> Iterator[Leaf]:
    for path, leaf in leaves(value, kind, known):
        yield (name, *path), leaf


def _number(value: Any, kind: Any) -> bool | int | float:
    if isinstance(value, bool | np.bool_):
        return bool(value)
    is_float = any(isinstance(option, type) and issubclass(option, float | np.floating) for option in _options(kind))
    return int(value) if isinstance(value, numbers.Integral) and not is_float else float(value)


def _array(value: Any, kind: Any) -> Any:
    """A list or tuple as an array: of the annotated numbers if they are floats or there are none, else as it comes."""
    array = np.asarray(value)
    items = [item for option in _options(kind) for item in get_args(option) if item is not Ellipsis]
    if (
        array.dtype.kind in "biuf"
        and items
        and all(isinstance(item, type) and issubclass(item, NUMBERS) for item in items)
    ):
        annotated = np.result_type(*items)
        return array.astype(annotated if annotated.kind == "f" or not array.size else array.dtype, copy=False)
    return array


@lru_cache(maxsize=256)
def field_types(kind: type) -> dict[str, Any]:
    """The public fields of a dataclass with their types, without those of a message header."""
    hints = {name: unaliased(hint) for name, hint in get_type_hints(kind).items()}
    names = (item.name for item in fields(kind))
    return {name: hints[name] for name in names if name not in _HEADER_FIELDS and not name.startswith("_")}


def refusal(kind: Any, known: tuple[type, ...] = (), within: tuple[Any, ...] = ()) -> str:
    """Why items of an annotated type cannot be taken apart, as part of a sentence; empty where they can."""
    for option in _options(kind):
        if why := _refusal(option, known, within):
            return why
    return ""


def _options(kind: Any) -> list[Any]:
    """The alternatives of a union without None, or the type itself."""
    kind = unaliased(kind)
    options = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    return [option for option in options if option is not NoneType]


def _refusal(kind: Any, known: tuple[type, ...], within: tuple[Any, ...]) -> str:
    plain = plain_type(kind)
    if not isinstance(plain, type) or kind in within:
        return f"{kind} has no standard form"
    if issubclass(plain, (*known, str, *NUMBERS)):
        return ""
    if issubclass(plain, np.ndarray):
        dtype = (get_args((get_args(kind) or (Any, Any))[1]) or (Any,))[0]
        is_number = (
            dtype is Any or not isinstance(dtype, type) or issubclass(dtype, (np.bool_, np.integer, np.floating))
        )
        return "" if is_number else f"an array of {dtype.__name__} has no standard form"
    if issubclass(plain, Mapping):
        return refusal(get_args(kind)[1], known, (*within, kind)) if get_args(kind) else ""
    if issubclass(plain, tuple | list):
        items = [item for item in get_args(kind) if item is not Ellipsis]
        if items and all(isinstance(item, type) and issubclass(item, NUMBERS) for item in items):
            return ""
        return f"a {plain.__name__} of anything but numbers has no standard form"
    if not is_dataclass(plain):
        return f"{plain.__name__} has no standard form"
    try:
        inner = field_types(plain)
    except Exception as error:  # an annotation of the user's own may fail in any way
        return f"the annotations of {plain.__name__} cannot be read ({error})"
    whys = {name: refusal(field_kind, known, (*within, kind)) for name, field_kind in inner.items()}
    return next((f"in its field '{name}', {why}" for name, why in whys.items() if why), "")
