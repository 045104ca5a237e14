"""Numbers with units, as pipeline files write them: `5 ms`, `0.05 m`, `20 deg`."""

from __future__ import annotations

import math
import re
from fractions import Fraction

# unit -> (quantity, size); sizes are whole numbers where possible, so that conversions are exact
UNITS: dict[str, tuple[str, float]] = {
    "ns": ("time", 1.0),
    "us": ("time", 1e3),
    "ms": ("time", 1e6),
    "s": ("time", 1e9),
    "min": ("time", 60e9),
    "mm": ("length", 1.0),
    "cm": ("length", 10.0),
    "m": ("length", 1e3),
    "km": ("length", 1e6),
    "rad": ("angle", 1.0),
    "deg": ("angle", math.pi / 180),
    "px": ("number of pixels", 1.0),
    "Hz": ("frequency", 1.0),
    "%": ("share", 1e-2),
    "share": ("share", 1.0),
    "": ("number", 1.0),
}

# quantities that need a unit in a pipeline file, and the units to suggest
_WRITTEN = {"time": ("ms", "s"), "length": ("cm", "m"), "angle": ("deg", "rad"), "share": ("%",)}

_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([A-Za-z%]*)\s*$")


def quantity(text: str, unit: str) -> float:
    """The value of `text` in `unit`. Raises ValueError if it is not a number or has another dimension.

    >>> quantity("5 ms", "s")
    0.005
    """
    match = _QUANTITY.match(text)
    if match is None:
        raise ValueError(f"'{text}' is not a number{f' with a unit such as 5 {unit}' if unit else ''}")
    number, given = float(match[1]), match[2]
    if given == "":
        check_bare(number, unit)
        return number
    wanted, base = UNITS.get(unit, (unit, 1.0))
    if given not in (*UNITS, unit):
        known = [name for name, (kind, _) in UNITS.items() if kind == wanted and name] or [unit or "a plain number"]
        raise ValueError(f"'{text}' has the unknown unit '{given}'; expected {', '.join(known)}")
    kind, size = UNITS.get(given, (given, 1.0))
    if kind != wanted:
        usual = " or ".join(_WRITTEN.get(wanted, ()))
        units = f" in {usual}" if usual else f", such as {match[1]} {unit}"
        plain = f"a plain number such as {number * size:.9g}" if kind == "share" else "a plain number"
        raise ValueError(f"'{text}' is {_a(kind)}; expected {f'{_a(wanted)}{units}' if unit else plain}")
    if given == unit or number == 0 or not math.isfinite(number):
        return number
    return float(Fraction(match[1]) * Fraction(size) / Fraction(base))  # 4.1 ms are 4100000 ns, not a bit less


def check_bare(number: float, unit: str) -> None:
    """Raise ValueError for a number without a unit where `unit` is one of time, length or angle; 0 needs none."""
    units = _WRITTEN.get(UNITS.get(unit, ("", 1.0))[0])
    if units and number and math.isfinite(number):
        shown = f"{100 * number if units == ('%',) and abs(number) <= 1 else number:.15g}"
        raise ValueError(f"{number:.15g} needs a unit; write {' or '.join(f'{shown} {name}' for name in units)}")


def as_written(value: float, unit: str) -> str:
    """A number of `unit` in the most readable unit.

    >>> as_written(5_000_000, "ns")
    '5 ms'
    """
    kind, base = UNITS.get(unit, (unit, 1.0))
    if kind not in _WRITTEN or not value:
        return f"{value:.9g}"
    numbers = {name: value * base / UNITS[name][1] for name in _WRITTEN[kind]}
    texts = [(abs(number) < 1, f"{number:.9g} {name}") for name, number in numbers.items()]
    return min(texts, key=lambda text: (text[0], len(text[1])))[1]


def _a(noun: str) -> str:
    return f"{'an' if noun[0] in 'aeiou' else 'a'} {noun}"
