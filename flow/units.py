"""Numbers with units, as pipeline files write them: `5 ms`, `0.05 m`, `20 deg`."""

from __future__ import annotations

import math
import re

# unit -> (what it measures, factor to that quantity's base unit)
UNITS: dict[str, tuple[str, float]] = {
    "ns": ("time", 1e-9),
    "us": ("time", 1e-6),
    "ms": ("time", 1e-3),
    "s": ("time", 1.0),
    "min": ("time", 60.0),
    "mm": ("length", 1e-3),
    "cm": ("length", 1e-2),
    "m": ("length", 1.0),
    "km": ("length", 1e3),
    "rad": ("angle", 1.0),
    "deg": ("angle", math.pi / 180),
    "px": ("pixels", 1.0),
    "Hz": ("frequency", 1.0),
    "%": ("share", 1e-2),
    "": ("number", 1.0),
}

_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([A-Za-z%]*)\s*$")


def quantity(text: str, unit: str) -> float:
    """The value of `text` in `unit`. Raises ValueError if it is no number or measures something else.

    >>> quantity("5 ms", "s")
    0.005
    """
    match = _QUANTITY.match(text)
    if match is None:
        raise ValueError(f"'{text}' is not a number with a unit such as '5 {unit or 'ms'}'")
    number, given = float(match[1]), match[2]
    if given == "":
        return number
    if given not in UNITS:
        raise ValueError(f"'{text}' has the unknown unit '{given}'; expected {unit or 'a plain number'}")
    kind, factor = UNITS[given]
    wanted, base = UNITS[unit]
    if kind != wanted:
        raise ValueError(f"'{text}' is a {kind}; expected {f'a {wanted} in {unit}' if unit else 'a plain number'}")
    return number if given == unit else number * factor / base
