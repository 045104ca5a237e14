"""A grid without bounds: cells of one dtype, kept in square tiles that exist only where something was written.

Cells are addressed by whole numbers (row, column), of either sign. What was never written reads as zeros, so a dtype is
chosen such that zero means that nothing is known.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

SIDE = 32  # cells of a tile's side: 1.6 m of 0.05 m cells, so that a track of 20 m wastes a twelfth at its borders


@dataclass(eq=False)
class Tiles:
    """A sparse grid of cells of `dtype`."""

    dtype: np.dtype[np.void]
    tiles: dict[tuple[int, int], Array] = field(default_factory=dict)

    def read(self, row: int, col: int, rows: int, cols: int) -> Array:
        """A copy of the block of (rows, cols) cells whose first is (row, col)."""
        block = np.zeros((rows, cols), self.dtype)
        for place, inside, part in _parts(row, col, rows, cols):
            if place in self.tiles:
                block[part] = self.tiles[place][inside]
        return block

    def write(self, row: int, col: int, block: Array, changed: Array) -> None:
        """Store the cells of `block` (rows, cols) where `changed` (rows, cols) bool; its first cell is (row, col)."""
        for place, inside, part in _parts(row, col, *block.shape):
            if changed[part].any():
                tile = self.tiles.setdefault(place, np.zeros((SIDE, SIDE), self.dtype))
                np.copyto(tile[inside], block[part], where=changed[part])


def _parts(
    row: int, col: int, rows: int, cols: int
) -> Iterator[tuple[tuple[int, int], tuple[slice, slice], tuple[slice, slice]]]:
    """The tiles that a block touches: each with its place, and the common cells as slices of tile and of block."""
    for tile_row, inside_row, part_row in _spans(row, rows):
        for tile_col, inside_col, part_col in _spans(col, cols):
            yield (tile_row, tile_col), (inside_row, inside_col), (part_row, part_col)


def _spans(start: int, length: int) -> Iterator[tuple[int, slice, slice]]:
    for tile in range(start // SIDE, (start + length - 1) // SIDE + 1):
        low, high = max(start, tile * SIDE), min(start + length, (tile + 1) * SIDE)
        yield tile, slice(low - tile * SIDE, high - tile * SIDE), slice(low - start, high - start)
