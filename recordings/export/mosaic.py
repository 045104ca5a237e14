"""Maps of one grid laid over each other, as windows that followed the rover, into one map of all they show.

A window lies over what was there before, except at its rim: what a map says there rests on a part of its surroundings
only, so it gives way to what a window says whose middle the cell was in.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from recordings.errors import LogError
from stages.data import Array, Tiles

LARGEST = 1 << 31  # cells of a rectangle; pictures of more are beyond what their readers take
RIM = 1.5  # m; slopes and steps are measured over less than that; what a frame changes lies farther inside
STRIP = 256  # rows that are read at a time, so that no map is in memory as a whole
_ON_GRID = 1e-3  # of a cell; how far from its place a grid's corner may be by rounding


@dataclass(eq=False)
class Mosaic:
    """One or more maps of one resolution and frame, with layers of one type each.

    fills: layer -> value of a cell that nothing is known of. After `close`, `shape` (rows, cols) and `origin` (x, y of
    the lower left corner, m) are those of the smallest rectangle of cells in which `known` was true anywhere.
    """

    resolution: float
    frame_id: str
    fills: Mapping[str, np.generic]
    rim: float = RIM
    shape: tuple[int, int] = field(init=False, default=(0, 0))
    _first: tuple[int, int] = field(init=False, default=(0, 0))

    def __post_init__(self) -> None:
        layers = [(name, fill.dtype) for name, fill in self.fills.items()]
        self._cells = Tiles(np.dtype([*layers, ("laid", np.uint8)]))  # laid: 1 by a rim, 2 by a middle
        self._low, self._high = np.full(2, 2**60), np.full(2, -(2**60))

    @property
    def origin(self) -> tuple[float, float]:
        """x and y of the lower left corner, m."""
        row, col = self._first
        return col * self.resolution, row * self.resolution

    def lay(
        self, layers: Mapping[str, Array], known: Array, resolution: float, origin: tuple[float, float], frame_id: str
    ) -> None:
        """Lay a map on top; known: (rows, cols) bool, which of its cells are to be in the rectangle.

        Raises LogError where it does not fit those before.
        """
        same = (frame_id, list(layers)) == (self.frame_id, list(self.fills))
        if not same or abs(resolution / self.resolution - 1) > 1e-6:
            raise LogError(
                f"the maps change on the way: {', '.join(layers)} at {resolution:g} m in '{frame_id}' after "
                f"{', '.join(self.fills)} at {self.resolution:g} m in '{self.frame_id}'; export the parts on their own"
            )
        corner = np.array([origin[1], origin[0]]) / self.resolution
        first = np.rint(corner).astype(int)
        if np.abs(corner - first).max() > _ON_GRID:
            raise LogError(f"a map begins at {origin} m, which is no whole number of cells of {self.resolution:g} m")
        row, col = first.tolist()
        block = self._cells.read(row, col, *known.shape)
        middle = np.zeros(known.shape, bool)
        rim = round(self.rim / self.resolution)
        middle[rim : known.shape[0] - rim, rim : known.shape[1] - rim] = True
        changed = middle | (block["laid"] < 2)
        for name, layer in layers.items():
            block[name] = layer
        block["laid"] = np.where(middle, 2, 1)
        self._cells.write(row, col, block, changed)
        places = np.argwhere(known)
        if len(places):
            self._low = np.minimum(self._low, places.min(0) + first)
            self._high = np.maximum(self._high, places.max(0) + first)

    def close(self, like: Mosaic | None = None) -> bool:
        """Settle shape and origin, those of the map `like` where given; False where no cell is known.

        Raises LogError where the rectangle is larger than `LARGEST`.
        """
        if like is not None:
            self.shape, self._first = like.shape, like._first
        elif (self._low <= self._high).all():
            rows, cols = (int(extent) for extent in self._high - self._low + 1)
            if rows * cols > LARGEST:
                size = f"{cols * self.resolution:g} x {rows * self.resolution:g} m"
                raise LogError(
                    f"the map in '{self.frame_id}' reaches over {size}, too far for one picture with cells of "
                    f"{self.resolution:g} m: did its pose jump? add --frames to export the maps of every frame"
                )
            self.shape, self._first = (rows, cols), (int(self._low[0]), int(self._low[1]))
        return min(self.shape) > 0

    def block(self, layer: str, row: int, col: int, rows: int, cols: int) -> Array:
        """Cells of a layer, (rows, cols), the first being (row, col) of the rectangle; outside it nothing is known."""
        cells = self._cells.read(self._first[0] + row, self._first[1] + col, rows, cols)
        inside = np.zeros((rows, cols), bool)
        inside[max(0, -row) : max(0, self.shape[0] - row), max(0, -col) : max(0, self.shape[1] - col)] = True
        return np.where(inside & (cells["laid"] > 0), cells[layer], self.fills[layer])

    def strips(self, layer: str) -> Iterator[Array]:
        """The layer from its largest y downwards, as blocks (up to `STRIP`, cols) whose first row is the uppermost."""
        for top in range(self.shape[0], 0, -STRIP):
            low = max(0, top - STRIP)
            yield self.block(layer, low, 0, top - low, self.shape[1])[::-1]
