"""An unbounded sparse grid: cells of one dtype in square tiles, allocated on the first write.

Row and column may be negative. Cells that were never written read as zeros, so zero must mean "unknown".
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from stages.data.arrays import Array, Span

TILE_SIDE = 32  # cells: 1.6 m at 0.05 m a cell, so a track 20 m wide wastes a twelfth at its borders


@dataclass(eq=False)
class Tiles:
    """A sparse grid of cells of `dtype`."""

    dtype: np.dtype[np.void]
    tiles: dict[tuple[int, int], Array] = field(default_factory=dict)

    def snapshot(self) -> Tiles:
        """The cells as they are now. `write` replaces a tile and does not change it, so this copies no cells."""
        return Tiles(self.dtype, dict(self.tiles))

    def read(self, row: int, col: int, rows: int, cols: int) -> Array:
        """A copy of the (rows, cols) cells from (row, col) on."""
        block = np.zeros((rows, cols), self.dtype)
        raw = _raw(block)
        for index, inside, part in _parts(row, col, rows, cols):
            if index in self.tiles:
                raw[part] = _raw(self.tiles[index])[inside]
        return block

    def write(self, row: int, col: int, block: Array, changed: Array) -> None:
        """Store the cells of `block` from (row, col) on, where `changed`, (rows, cols) bool, is set."""
        for index, inside, part in _parts(row, col, *block.shape):
            if changed[part].any():
                old = self.tiles.get(index)
                tile = np.zeros((TILE_SIDE, TILE_SIDE), self.dtype) if old is None else copied(old)
                np.copyto(_raw(tile)[inside], _raw(block)[part], where=changed[part])
                self.tiles[index] = tile


def taken(cells: Array, where: Array) -> Array:
    """A copy of the cells of a mask, (n,): `cells[where]`, many times faster where a cell has fields."""
    return np.asarray(_raw(cells)[where].view(cells.dtype))


def put(cells: Array, where: Array, values: Array) -> None:
    """Set the cells of a mask to values (n,): `cells[where] = values`, many times faster where a cell has fields."""
    _raw(cells)[where] = _raw(values)


def copied(cells: Array) -> Array:
    """A copy of contiguous cells."""
    return _raw(cells).copy().view(cells.dtype)


def _raw(cells: Array) -> Array:
    """The cells as bytes, which numpy copies as a whole and not field by field."""
    return cells.view(np.dtype((np.void, cells.dtype.itemsize)))


def _parts(row: int, col: int, rows: int, cols: int) -> Iterator[tuple[tuple[int, int], Span, Span]]:
    """The tiles that a block overlaps: index of the tile, then the common cells as slices of tile and block."""
    for tile_row, inside_row, part_row in _spans(row, rows):
        for tile_col, inside_col, part_col in _spans(col, cols):
            yield (tile_row, tile_col), (inside_row, inside_col), (part_row, part_col)


def _spans(start: int, length: int) -> Iterator[tuple[int, slice, slice]]:
    for tile in range(start // TILE_SIDE, (start + length - 1) // TILE_SIDE + 1):
        low, high = max(start, tile * TILE_SIDE), min(start + length, (tile + 1) * TILE_SIDE)
        yield tile, slice(low - tile * TILE_SIDE, high - tile * TILE_SIDE), slice(low - start, high - start)
