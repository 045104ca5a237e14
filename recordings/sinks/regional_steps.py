"""Which maps in the pose's frame are written: one for each step of the rover, and the last one."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from stages.data import LEVEL_FRAME, ElevationMap, NavigationMap, Transform

AHEAD = (4.0, 0.0, 0.0)  # m in frame `level`; the place that moves when the rover turns


class RegionalMaps(NamedTuple):
    """The regional maps of a frame: stream -> map, and where frame `level` is in their frame, if known."""

    stamp: int
    maps: Mapping[str, ElevationMap | NavigationMap]
    level: Transform | None

    @property
    def origins(self) -> list[tuple[str, str, int | None]]:
        """Streams, frames of reference and epochs: maps that differ in these do not continue each other."""
        return [(name, item.frame_id, getattr(item, "epoch", None)) for name, item in self.maps.items()]


@dataclass
class RegionalSteps:
    """Holds a frame's maps back until the rover has moved by `step` m on from the maps last written.

    A map contains those before it, so held maps are dropped for the next ones until these are farther away. Then the
    held ones are written, as they are before maps that do not continue them.
    """

    step: float
    _held: RegionalMaps | None = field(default=None, init=False)
    _last: RegionalMaps | None = field(default=None, init=False)  # of any frame
    _moved: float = field(default=0.0, init=False)  # m, from the maps last written to the last ones

    def due(self, new: RegionalMaps) -> list[RegionalMaps]:
        """What is to be written now that a frame's maps are there, in the order of stamps."""
        held, last, self._held, self._last = self._held, self._last, None, new
        before = [] if held is None else [held]
        way = way_between(last, new) if last and self.step else math.inf
        if not math.isfinite(way):
            self._moved = 0.0
            return [*before, new]
        self._held, self._moved = new, self._moved + way
        if self._moved <= self.step:
            return []
        self._moved = way if held is not None else self._moved
        return before

    def rest(self) -> list[RegionalMaps]:
        """What is still to be written at the end."""
        held, self._held = self._held, None
        return [] if held is None else [held]


def regional_maps(stamp: int, items: Mapping[str, Any], names: Iterable[str]) -> RegionalMaps:
    """Those of the named maps of a frame that are in another frame of reference than `level`."""
    maps = {
        name: items[name] for name in names
        if isinstance(items.get(name), ElevationMap | NavigationMap) and items[name].frame_id != LEVEL_FRAME
    }  # fmt: skip
    frames = {item.frame_id for item in maps.values()}
    levels = (getattr(item, "level", None) for item in items.values())
    known = (level for level in levels if isinstance(level, Transform) and {level.parent} == frames)
    return RegionalMaps(stamp, maps, next(known, None))


def way_between(one: RegionalMaps, other: RegionalMaps) -> float:
    """How far the rover has moved, m, or the place 4 m ahead of it, if that is more; inf if it is not known."""
    if one.level is None or other.level is None or one.origins != other.origins:
        return math.inf
    before, after = (level(np.array([[0.0, 0.0, 0.0], AHEAD])) for level in (one.level, other.level))
    return float(np.linalg.norm((after - before)[:, :2], axis=1).max())
