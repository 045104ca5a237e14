"""The fused regional map: what it keeps of each cell, and how a frame is merged into it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from stages.data import Array, Transform
from stages.data.tiles import Tiles, copied, put, taken
from stages.terrain.height_alignment import plane_height
from stages.terrain.map_levelling import MapLevelling

SHARED_SHARE = 0.2  # share of the smallest variance of a cell's frames that they have in common
MAX_CONTRADICTION = 3.0  # standard deviations between two heights of a cell
# 29 bytes a cell. weight: sum of 1 / variance over its frames; best: their smallest standard deviation; below, above:
# from the height to the extremes; first, last: ms since the epoch; doubt: height difference to the newest frame while
# it contradicts the cell. Integers saturate. Cells seen by no frame but hidden from one have weight HIDDEN, and their
# height is the ceiling.
CELL = np.dtype(
    [
        ("height", "f4"), ("weight", "f4"), ("best", "f2"), ("below", "f2"), ("above", "f2"), ("count", "u2"),
        ("first", "u4"), ("last", "u4"), ("frames", "u2"), ("contradictions", "u1"), ("doubt", "f2"),
    ]
)  # fmt: skip
HIDDEN = -1.0
_MS = 1_000_000


@dataclass(eq=False)
class FusedMap:
    """The regional map so far, the state of `Fuse` and `FuseRegion`."""

    frame_id: str | None = None  # "" is a valid name
    epoch: int = 0  # ns, stamp of the first frame
    last: int | None = None  # ns, stamp of the last frame
    has_ceiling: bool = False  # whether the frames contain occluded cells
    cells: Tiles = field(default_factory=lambda: Tiles(CELL))
    levelling: MapLevelling | None = None  # None before the first frame
    plane: Array = field(default_factory=lambda: np.zeros(3))  # that aligned the last frame
    up_sum: Array = field(default_factory=lambda: np.zeros(3))  # of the tilts, in the map's frame
    planar: bool = True  # no pose has roll or pitch
    rejected: int = 0  # frames in succession that did not align
    resets: int = 0  # because of them
    logged: Transform | None = None  # frame `level` at the next frame, which the cells of a result log contain already

    def reset(self, frame_id: str, stamp: int) -> None:
        """Start an empty map."""
        self.frame_id, self.epoch, self.cells = frame_id, stamp, Tiles(CELL)
        self.levelling, self.logged, self.up_sum, self.planar = None, None, np.zeros(3), True

    def age(self, stamp: int) -> int:
        """Time since the epoch, ms."""
        return (stamp - self.epoch) // _MS


class Observation(NamedTuple):
    """What a frame shows of n cells, (n,) float64 each."""

    x: Array  # m from the rover
    y: Array
    elevation: Array  # m
    minimum: Array
    maximum: Array
    variance: Array  # m^2, of elevation
    points: Array

    def with_plane(self, plane: Array) -> Observation:
        """The same with a plane (3,) added to the heights."""
        up = plane_height(plane, self.x, self.y)
        return self._replace(elevation=self.elevation + up, minimum=self.minimum + up, maximum=self.maximum + up)

    def only(self, which: Array) -> Observation:
        """The cells of the mask (n,) bool `which`."""
        return Observation(*(values[which] for values in self))


def variance_of(cells: Array) -> Array:
    """Variance of the heights of known cells, m^2."""
    return np.asarray(1 / cells["weight"].astype(np.float64) + SHARED_SHARE * cells["best"].astype(np.float64) ** 2)


def merged(cells: Array, frame: Observation, now: int) -> Array:
    """The cells (n,) with a frame's observation at `now`, ms since the epoch."""
    cells, known = copied(cells), cells["frames"] > 0
    off = np.abs(frame.elevation - cells["height"])
    variance = np.full(len(cells), np.inf)
    variance[known] = variance_of(taken(cells, known))
    contradicted = known & (off > MAX_CONTRADICTION * np.sqrt(variance + frame.variance))
    replaced = contradicted & (frame.variance <= 2 * variance)  # the cell has lost half its weight
    unsettled = contradicted & ~replaced
    cells["weight"][contradicted] /= 2
    cells["best"][contradicted] *= np.float16(np.sqrt(2))
    cells["contradictions"][contradicted] = _saturated_sum(cells["contradictions"][contradicted], 1)
    cells["doubt"][unsettled] = off[unsettled]
    now = min(now, np.iinfo(CELL["first"]).max)
    new = ~known | replaced
    put(cells, new, _fresh(taken(cells, new), now))
    added = ~unsettled
    put(cells, added, _averaged(taken(cells, added), frame.only(added), now))
    return cells


def _fresh(cells: Array, now: int) -> Array:
    """Empty cells (n,) that keep their number of contradictions."""
    fresh = np.zeros(len(cells), CELL)
    fresh["first"], fresh["contradictions"] = now, cells["contradictions"]
    return fresh


def _averaged(cells: Array, frame: Observation, now: int) -> Array:
    """The cells (n,) with one more frame, weighted by inverse variance."""
    after, sigma = copied(cells), np.sqrt(frame.variance)
    weight = 1 / ((1 - SHARED_SHARE) * frame.variance + 1e-12)
    after["weight"] = total = cells["weight"] + weight
    share = weight / total
    below, above = frame.elevation - frame.minimum, frame.maximum - frame.elevation
    for name, value in (("height", frame.elevation), ("below", below), ("above", above)):
        after[name] = cells[name] + share * (value - cells[name])
    after["best"] = np.where(cells["frames"] > 0, np.minimum(cells["best"], sigma), sigma)
    after["count"], after["frames"] = _saturated_sum(cells["count"], frame.points), _saturated_sum(cells["frames"], 1)
    after["last"], after["doubt"] = now, 0
    return after


def _saturated_sum(numbers: Array, more: Array | int) -> Array:
    """Unsigned numbers plus `more`, at most the largest of their type."""
    largest = np.iinfo(numbers.dtype).max
    return np.asarray(np.minimum(numbers + np.asarray(more, np.float64), largest).astype(numbers.dtype))


def with_ceiling(cells: Array, ceiling: Array) -> Array:
    """Cells (n,) seen by no frame, with the lower of their ceiling and a frame's, (n,) m."""
    cells = copied(cells)
    cells["height"] = np.where(cells["weight"] == HIDDEN, np.minimum(cells["height"], ceiling), ceiling)
    cells["weight"] = HIDDEN
    return cells


def layers_of(cells: Array, has_ceiling: bool) -> dict[str, Array]:
    """The layers of an elevation map, float32, from cells (rows, cols)."""
    known = cells["frames"] > 0
    seen = taken(cells, known)
    doubt = seen["doubt"].astype(np.float64)
    layers = {
        "elevation": _scattered(known, seen["height"]),
        "minimum": _scattered(known, seen["height"] - seen["below"]),
        "maximum": _scattered(known, seen["height"] + seen["above"]),
        "count": cells["count"].astype(np.float32),
        "variance": _scattered(known, variance_of(seen) + np.square(doubt)),
        "first": _scattered(known, seen["first"] / 1e3),
        "last": _scattered(known, seen["last"] / 1e3),
        "frames": cells["frames"].astype(np.float32),
        "contradictions": cells["contradictions"].astype(np.float32),
    }
    if has_ceiling:
        hidden = cells["weight"] == HIDDEN
        layers["occluded"] = np.where(known, 0, np.where(hidden, 1, np.nan)).astype(np.float32)
        layers["ceiling"] = _scattered(hidden, cells["height"][hidden])
    return layers


def cells_of(layers: Mapping[str, Array]) -> Array:
    """The cells (rows, cols) from `layers_of`, as if all frames of a cell had the same variance, and none a doubt."""
    known = layers["frames"] > 0
    cells = np.zeros(known.shape, CELL)
    seen = {name: layer[known].astype(np.float64) for name, layer in layers.items()}
    variance = seen["variance"] / ((1 - SHARED_SHARE) / seen["frames"] + SHARED_SHARE)  # of each frame
    values = {
        "height": seen["elevation"], "below": seen["elevation"] - seen["minimum"], "best": np.sqrt(variance),
        "above": seen["maximum"] - seen["elevation"], "weight": seen["frames"] / ((1 - SHARED_SHARE) * variance),
        "first": np.rint(1e3 * seen["first"]), "last": np.rint(1e3 * seen["last"]),
        **{name: seen[name] for name in ("count", "frames", "contradictions")},
    }  # fmt: skip
    for name, value in values.items():
        cells[name][known] = value
    hidden = layers.get("occluded", np.zeros(known.shape)) == 1
    cells["weight"][hidden] = HIDDEN
    cells["height"][hidden] = layers["ceiling"][hidden] if hidden.any() else 0
    return cells


def _scattered(where: Array, values: Array) -> Array:
    """Values (n,) in the cells of the mask `where` (rows, cols), NaN in the others; float32."""
    layer = np.full(where.shape, np.nan, np.float32)
    layer[where] = values
    return layer
