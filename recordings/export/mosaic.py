"""One map from many windows on the same grid, as they followed the rover.

A window replaces what was there before, except at its rim: cells there were computed from only a part of their
surroundings, so they do not replace cells of the middle of another window.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from recordings.errors import LogError
from stages.data import RIM_WIDTH, Array, ElevationMap, NavigationMap, Tiles

MAX_CELLS = 1 << 31  # of a rectangle; readers refuse larger pictures
STRIP_ROWS = 256  # that are read at a time, so that no map is in memory as a whole
_MAX_GRID_OFFSET, _MAX_STRETCH = 1e-3, 1e-6  # of a cell, by rounding


@dataclass(eq=False)
class Mosaic:
    """The layers of one or more maps of one resolution and frame of reference.

    fills: layer -> value of an unknown cell, of the layer's type. After `close`, `shape` (rows, cols) and `origin` (x,
    y of the lower left corner, m) are those of the smallest rectangle around the known cells.
    """

    resolution: float
    frame_id: str
    fills: Mapping[str, np.generic]
    rim: float = RIM_WIDTH
    shape: tuple[int, int] = field(init=False, default=(0, 0))
    _first: tuple[int, int] = field(init=False, default=(0, 0))

    def __post_init__(self) -> None:
        layers = [(name, fill.dtype) for name, fill in self.fills.items()]
        self._cells = Tiles(np.dtype([*layers, ("added", np.uint8)]))  # added: 1 by a rim, 2 by a middle
        self._low, self._high = np.full(2, 2**60), np.full(2, -(2**60))

    @property
    def origin(self) -> tuple[float, float]:
        """x and y of the lower left corner, m."""
        row, col = self._first
        return col * self.resolution, row * self.resolution

    def has_grid(self, grid: Mosaic | ElevationMap | NavigationMap) -> bool:
        """Whether a map has the frame of reference and, but for rounding, the cell size of this one."""
        return grid.frame_id == self.frame_id and abs(grid.resolution / self.resolution - 1) <= _MAX_STRETCH

    def add(self, layers: Mapping[str, Array], known: Array, grid: ElevationMap | NavigationMap) -> None:
        """Add a window of a grid, whose cells `known` (rows, cols) bool are to be in the rectangle.

        Raises LogError if it does not fit the windows before.
        """
        resolution, origin = grid.resolution, grid.origin
        if list(layers) != list(self.fills) or not self.has_grid(grid):
            raise LogError(
                f"the maps of the log differ: {', '.join(layers)} at {resolution:g} m in '{grid.frame_id}' after "
                f"{', '.join(self.fills)} at {self.resolution:g} m in '{self.frame_id}'; export the parts separately"
            )
        corner = np.array([origin[1], origin[0]]) / self.resolution
        first = np.rint(corner).astype(int)
        if np.abs(corner - first).max() > _MAX_GRID_OFFSET:
            raise LogError(f"a map begins at {origin} m, which is not a whole number of cells of {self.resolution:g} m")
        row, col = first.tolist()
        block = self._cells.read(row, col, *known.shape)
        middle = np.zeros(known.shape, bool)
        rim = round(self.rim / self.resolution)
        middle[rim : known.shape[0] - rim, rim : known.shape[1] - rim] = True
        changed = middle | (block["added"] < 2)
        for name, layer in layers.items():
            block[name] = layer
        block["added"] = np.where(middle, 2, 1)
        self._cells.write(row, col, block, changed)
        places = np.argwhere(known)
        if len(places):
            self._low = np.minimum(self._low, places.min(0) + first)
            self._high = np.maximum(self._high, places.max(0) + first)

    def close(self, like: Mosaic | None = None, advice: str = "") -> bool:
        """Set shape and origin, those of `like` if given; returns whether any cell is known.

        Raises LogError with `advice` if the rectangle is larger than `MAX_CELLS`.
        """
        if like is not None:
            self.shape, self._first = like.shape, like._first
        elif (self._low <= self._high).all():
            rows, cols = (int(extent) for extent in self._high - self._low + 1)
            if rows * cols > MAX_CELLS:
                size = f"{cols * self.resolution:g} x {rows * self.resolution:g} m"
                raise LogError(
                    f"the map in '{self.frame_id}' is {size}, too large for one picture with cells of "
                    f"{self.resolution:g} m{advice}"
                )
            self.shape, self._first = (rows, cols), (int(self._low[0]), int(self._low[1]))
        return min(self.shape) > 0

    def block(self, layer: str, row: int, col: int, rows: int, cols: int) -> Array:
        """Cells of a layer, (rows, cols), from (row, col) of the rectangle on; outside it cells are unknown."""
        cells = self._cells.read(self._first[0] + row, self._first[1] + col, rows, cols)
        inside = np.zeros((rows, cols), bool)
        inside[max(0, -row) : max(0, self.shape[0] - row), max(0, -col) : max(0, self.shape[1] - col)] = True
        return np.where(inside & (cells["added"] > 0), cells[layer], self.fills[layer])

    def overview(self, layer: str, max_side: int) -> tuple[Array, float]:
        """The largest value of each square of cells, at most `max_side` squares a side, and their size, m."""
        step = -(-max(self.shape) // max_side)
        rows, cols = (-(-length // step) for length in self.shape)
        blocks = (self.block(layer, row * step, 0, step, cols * step) for row in range(rows))
        squares = (block.reshape(step, cols, step) for block in blocks)
        largest = [np.fmax.reduce(square, axis=(0, 2), keepdims=True).ravel() for square in squares]
        return np.stack(largest), step * self.resolution

    def tiles(self) -> Iterator[tuple[tuple[int, int], dict[str, Array]]]:
        """Index of each tile of `TILE_SIDE` cells, counted from the origin of the frame, and its layers."""
        for index, tile in self._cells.tiles.items():
            yield index, {name: np.where(tile["added"] > 0, tile[name], fill) for name, fill in self.fills.items()}

    def strips(self, layer: str) -> Iterator[Array]:
        """The layer from its largest y on, in blocks (up to `STRIP_ROWS`, cols) whose first row is the uppermost."""
        for top in range(self.shape[0], 0, -STRIP_ROWS):
            low = max(0, top - STRIP_ROWS)
            yield self.block(layer, low, 0, top - low, self.shape[1])[::-1]
