"""The regional map: what is remembered of a cell, how what a frame shows of it enters there, and what it then tells."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from stages.data import Array
from stages.data.tiles import Tiles
from stages.terrain.height_alignment import rise

# What is remembered of a cell, 29 bytes. weight: sum of 1 / variance over its frames; best: the smallest standard
# deviation among them; below, above: from the height to the cell's extremes; first, last: ms since the first frame;
# numbers stop at the largest of their type; doubt: by how much the newest frame contradicts it, where that is not
# settled. Where no frame saw it, but one looked, weight is HIDDEN and height what it must lie below.
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
    """The map so far: its frame, the stamps of its first and last frame, ns, whether those tell what was hidden from
    them, its cells, the plane that joined the last frame, the sum of up as the tilts tell it in the map's frame, how
    many frames in succession did not join, and how often the map began anew for that."""

    frame_id: str | None = None  # a pose may be in a frame without a name
    epoch: int = 0
    last: int = -1
    hides: bool = False
    cells: Tiles = field(default_factory=lambda: Tiles(CELL))
    plane: Array = field(default_factory=lambda: np.zeros(3))
    ups: Array = field(default_factory=lambda: np.zeros(3))
    refused: int = 0
    anew: int = 0

    def begin(self, frame_id: str, stamp: int) -> None:
        """Start anew: nothing joins the two."""
        self.frame_id, self.epoch, self.cells = frame_id, stamp, Tiles(CELL)
        self.plane, self.ups = np.zeros(3), np.zeros(3)

    def age(self, stamp: int) -> int:
        """The time since the first frame, ms."""
        return (stamp - self.epoch) // _MS


class Observation(NamedTuple):
    """What a frame shows of n cells, (n,) float64 each: how far from the rover they lie, m, their heights, m, the
    variance of `elevation`, m^2, and how many points they hold."""

    x: Array
    y: Array
    elevation: Array
    minimum: Array
    maximum: Array
    variance: Array
    points: Array

    def raised(self, plane: Array) -> Observation:
        """The same, with a plane (3,) added to the heights."""
        up = rise(plane, self.x, self.y)
        return self._replace(elevation=self.elevation + up, minimum=self.minimum + up, maximum=self.maximum + up)

    def only(self, which: Array) -> Observation:
        """The cells of the mask (n,) bool `which`."""
        return Observation(*(values[which] for values in self))


def variance_of(cells: Array, shared: float) -> Array:
    """Variance of the heights of known cells, m^2; shared: of its frames' least, the share that all have in common."""
    return np.asarray(1 / cells["weight"].astype(np.float64) + shared * cells["best"].astype(np.float64) ** 2)


def merged(cells: Array, seen: Observation, now: int, contradiction: float, shared: float) -> Array:
    """The cells (n,) with what a frame saw in them at `now`, ms since the first.

    contradiction: standard deviations, beyond which it contradicts a cell; shared: of `variance_of`.
    """
    cells, known = cells.copy(), cells["frames"] > 0
    off = np.abs(seen.elevation - cells["height"])
    have = np.full(len(cells), np.inf)
    have[known] = variance_of(cells[known], shared)
    contradicted = known & (off > contradiction * np.sqrt(have + seen.variance))
    replaced = contradicted & (seen.variance <= 2 * have)  # the cell has lost half its weight
    unsettled = contradicted & ~replaced  # until it is settled which is right, nobody may rely on the cell
    cells["weight"][contradicted] /= 2
    cells["best"][contradicted] *= np.float16(np.sqrt(2))
    cells["contradictions"][contradicted] = _sum(cells["contradictions"][contradicted], 1)
    cells["doubt"][unsettled] = off[unsettled]
    now = min(now, np.iinfo(CELL["first"]).max)
    new = ~known | replaced
    cells[new] = _fresh(cells[new], now)
    added = ~unsettled
    cells[added] = _averaged(cells[added], seen.only(added), now, shared)
    return cells


def _fresh(cells: Array, now: int) -> Array:
    """Cells (n,) that forget all but how often they were contradicted."""
    fresh = np.zeros(len(cells), CELL)
    fresh["first"], fresh["contradictions"] = now, cells["contradictions"]
    return fresh


def _averaged(cells: Array, seen: Observation, now: int, shared: float) -> Array:
    """The cells (n,) with what a frame saw in them as one more of their frames, weighted by inverse variance."""
    after, spread = cells.copy(), np.sqrt(seen.variance)
    weight = 1 / ((1 - shared) * seen.variance + 1e-12)
    after["weight"] = total = cells["weight"] + weight
    share = weight / total
    for name, value in (
        ("height", seen.elevation), ("below", seen.elevation - seen.minimum), ("above", seen.maximum - seen.elevation),
    ):  # fmt: skip
        after[name] = cells[name] + share * (value - cells[name])
    after["best"] = np.where(cells["frames"] > 0, np.minimum(cells["best"], spread), spread)
    after["count"], after["frames"] = _sum(cells["count"], seen.points), _sum(cells["frames"], 1)
    after["last"], after["doubt"] = now, 0
    return after


def _sum(numbers: Array, more: Array | int) -> Array:
    """Unsigned numbers with `more` added, or the largest of their type."""
    most = np.iinfo(numbers.dtype).max
    return np.asarray(np.minimum(numbers + np.asarray(more, np.float64), most).astype(numbers.dtype))


def hidden_below(cells: Array, ceiling: Array) -> Array:
    """Cells (n,) that no frame saw, and that lie below the heights `ceiling` (n,), m, too."""
    cells = cells.copy()
    cells["height"] = np.where(cells["weight"] == HIDDEN, np.minimum(cells["height"], ceiling), ceiling)
    cells["weight"] = HIDDEN
    return cells


def layers_of(cells: Array, shared: float, hides: bool) -> dict[str, Array]:
    """What the cells (rows, cols) tell, as layers of an elevation map, float32; hides: of `FusedMap`."""
    known = cells["frames"] > 0
    seen = cells[known]
    doubt = seen["doubt"].astype(np.float64)
    layers = {
        "elevation": _laid_out(known, seen["height"]),
        "minimum": _laid_out(known, seen["height"] - seen["below"]),
        "maximum": _laid_out(known, seen["height"] + seen["above"]),
        "count": cells["count"].astype(np.float32),
        "variance": _laid_out(known, variance_of(seen, shared) + np.square(doubt)),
        "first": _laid_out(known, seen["first"] / 1e3),
        "last": _laid_out(known, seen["last"] / 1e3),
        "frames": cells["frames"].astype(np.float32),
        "contradictions": cells["contradictions"].astype(np.float32),
    }
    if hides:
        hidden = cells["weight"] == HIDDEN
        layers["occluded"] = np.where(known, 0, np.where(hidden, 1, np.nan)).astype(np.float32)
        layers["ceiling"] = _laid_out(hidden, cells["height"][hidden])
    return layers


def _laid_out(where: Array, values: Array) -> Array:
    """Values (n,) in the cells of the mask `where` (rows, cols), NaN in the others; float32."""
    layer = np.full(where.shape, np.nan, np.float32)
    layer[where] = values
    return layer
