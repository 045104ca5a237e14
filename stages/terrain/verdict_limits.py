"""The limits of the hazard rule at one cell, and the changes of its parameters that would turn the verdict."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

from stages.data import Cell, ElevationMap
from stages.terrain.binarise import Binarise

FACTORS = tuple(1.01**step for step in range(1, 232))  # by which a parameter is changed, up to ten times its value
MAX_DIGITS = 12  # of a value
_LIMITS = ("max_step", "ground_clearance", "max_slope")  # of the rover


class Limit(NamedTuple):
    """What the rule compares: a value, NaN if unknown, and its limit. made_of: the parameters of a computed limit."""

    value: float
    limit: float
    unit: str
    made_of: str = ""


@dataclass(frozen=True)
class Turn:
    """A change of one parameter of the hazard rule that would turn a verdict. The values have the parameter's unit.

    needed: rounded away from `now` to as few digits, three at least, as turn it; an angle in degrees.
    """

    parameter: str
    now: float
    needed: float
    unit: str
    verdict: Cell


def limits_at(rule: Binarise, terrain: ElevationMap, row: int, col: int) -> dict[str, Limit]:
    """What the rule compares in a cell, by quantity."""
    layers = {name: float(layer[row, col]) for name, layer in terrain.layers.items()}
    if rule.method == "absolute" or "step" not in layers:
        return {"elevation": Limit(layers["elevation"], rule.rover.max_step, "m")}
    found = {
        "step": _height(rule, layers["step"], "max_step"),
        "height above the ground": _height(rule, layers["elevation"] - layers["ground"], "ground_clearance"),
        "slope": Limit(math.degrees(layers["slope"]), math.degrees(rule.rover.max_slope), "deg"),
        "steepness": Limit(math.degrees(layers["steepness"]), math.degrees(rule.rover.max_slope), "deg"),
        "roughness": Limit(layers["roughness"], rule.max_roughness, "m"),
    }
    if "variance" in layers:
        found["sigma of the height"] = Limit(math.sqrt(layers["variance"]), rule.max_sigma, "m")
    if "drop" in layers:
        found["drop"] = Limit(layers["drop"], rule.min_drop, "m")
    return found


def doubts_at(rule: Binarise, terrain: ElevationMap, row: int, col: int) -> list[str]:
    """In words, all that keeps the rule from calling a cell without a hazard free."""
    if math.isnan(terrain.layers["elevation"][row, col]):
        return []
    return [doubt for doubt, cells in rule.doubts(terrain).items() if cells[row, col]]


def limits_of(rule: Binarise) -> dict[str, float]:
    """Layer of an elevation map -> the value above which a cell is a hazard or unsure; slopes in degrees."""
    if rule.method == "absolute":
        return {"elevation": rule.rover.max_step}
    slope = math.degrees(rule.rover.max_slope)
    step = rule.rover.max_step - rule.height_margin
    limits = {"step": step, "slope": slope, "steepness": slope, "roughness": rule.max_roughness}
    return limits | {"variance": rule.max_sigma**2}


def _height(rule: Binarise, value: float, name: str) -> Limit:
    """A height against a limit of the rover, less the margin."""
    limit, margin = getattr(rule.rover, name), rule.height_margin
    return Limit(value, limit - margin, "m", f"rover.{name} {limit:g} - height_margin {margin:g}")


def turns_at(rule: Binarise, terrain: ElevationMap, row: int, col: int) -> list[Turn]:
    """The smallest change of each parameter of the rule that turns the verdict of a cell, the smallest first."""
    verdict = int(rule(terrain).cells[row, col])
    found = list[tuple[float, Turn]]()
    for name, value, unit in _numbers(rule):
        changes = [_turned(rule, name, value, (terrain, row, col), verdict, up) for up in (True, False)]
        known = [change for change in changes if change is not None]
        if known:
            factor, turned = min(known, key=lambda change: abs(math.log(change[0])))
            turn = Turn(name, value, _like(value, value * factor), unit, turned)
            found.append((abs(math.log(factor)), _rounded(turn, rule, (terrain, row, col))))
    return [turn for _, turn in sorted(found, key=lambda item: item[0])]


def _rounded(turn: Turn, rule: Binarise, place: tuple[ElevationMap, int, int]) -> Turn:
    """A turn with a value that can be typed."""
    into, back = (math.degrees, math.radians) if turn.unit == "rad" else (float, float)
    needed = into(turn.needed)
    for digits in range(3, MAX_DIGITS) if isinstance(turn.now, float) else ():
        step = 10.0 ** (math.floor(math.log10(needed)) + 1 - digits)
        typed = (math.ceil if turn.needed > turn.now else math.floor)(needed / step) * step
        value = back(float(f"{typed:.{digits}g}"))
        if _verdict(rule, turn.parameter, value, *place) == turn.verdict:
            return replace(turn, needed=value)
    return turn


def _turned(
    rule: Binarise, name: str, value: float, place: tuple[ElevationMap, int, int], verdict: int, up: bool
) -> tuple[float, Cell] | None:
    """The factor nearest to 1 by which a parameter turns a verdict, and the new verdict; None if none does."""
    factors = [1.0, *(FACTORS if up else (1 / factor for factor in FACTORS))]

    def at(factor: float) -> int | None:
        return _verdict(rule, name, _like(value, value * factor), *place)

    # Every test of the rule has one side of its limit, so a verdict that has turned does not turn back.
    first = bisect_left(factors, True, lo=1, key=lambda factor: at(factor) != verdict)
    turned = at(factors[first]) if first < len(factors) else None
    return None if turned is None else (factors[first], Cell(turned))


def _numbers(rule: Binarise) -> Iterator[tuple[str, float, str]]:
    """(Name, value, unit) of the rule's limits."""
    for known in fields(rule.rover):
        if known.name in _LIMITS:
            yield f"rover.{known.name}", getattr(rule.rover, known.name), known.metadata.get("unit", "")
    for known in fields(rule):
        value = getattr(rule, known.name)
        if isinstance(value, int | float) and not isinstance(value, bool) and value > 0:
            yield known.name, value, known.metadata.get("unit", "")


def _like(now: float, value: float) -> float:
    """A value of a parameter, a whole number if the parameter is one."""
    return round(value) if isinstance(now, int) else value


def _verdict(rule: Binarise, name: str, value: float, terrain: ElevationMap, row: int, col: int) -> int | None:
    """The verdict with another value of a parameter; None where the rule does not allow the value."""
    change: dict[str, Any] = {name.removeprefix("rover."): value}
    try:
        changed = replace(rule, **({"rover": replace(rule.rover, **change)} if name.startswith("rover.") else change))
    except ValueError:
        return None
    return int(changed(terrain).cells[row, col])
