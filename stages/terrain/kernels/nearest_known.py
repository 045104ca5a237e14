"""The nearest known cell of each of some cells of a grid.

The nearest one in each column is found first, for all cells of the grid. Then the columns on both sides of a cell are
searched outwards, until a column is farther away than the best cell so far.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array

FAR = 1 << 20  # cells, more than the sides of any grid; a cell that is not there is twice as far away


def nearest_known(known: Array, rows: Array, cols: Array, reach: int) -> tuple[Array, Array, Array]:
    """Row, column and distance, cells, of the cell of `known` nearest to each of some cells, as scipy.ndimage finds it.

    Of equally near ones, the first column's, and of that the first. Farther ones than `reach` columns may be left out;
    the distance is large where there is none.
    """
    row, col, squared = np.zeros_like(rows), np.zeros_like(cols), np.full(len(rows), FAR * FAR)
    closest = np.empty(known.shape, np.int32)
    _nearest_known(np.ascontiguousarray(known), rows, cols, reach, closest, row, col, squared)
    return row, col, np.sqrt(squared)


@kernel
def _nearest_known(known, rows, cols, reach, closest, row, col, squared):
    height, width = known.shape
    last = np.full(width, -2 * FAR, np.int32)
    for y in range(height):
        for x in range(width):
            last[x] = y if known[y, x] else last[x]
            closest[y, x] = last[x]
    last[:] = 2 * FAR
    for y in range(height - 1, -1, -1):
        for x in range(width):
            last[x] = y if known[y, x] else last[x]
            if last[x] - y < y - closest[y, x]:
                closest[y, x] = last[x]
    for i in range(rows.size):
        y, x, best = rows[i], cols[i], squared[i]
        for offset in range(reach + 1):
            if offset * offset > best:
                break
            for side in range(-1, 2, 2):
                column = x + side * offset
                if column < 0 or column >= width:
                    continue
                apart = (closest[y, column] - y) ** 2 + offset * offset
                if apart < best or (apart == best and side < 0):  # the column on the left is before all so far
                    best, row[i], col[i] = apart, closest[y, column], column
        squared[i] = best


def nearest_known_reference(known: Array, rows: Array, cols: Array, reach: int) -> tuple[Array, Array, Array]:
    """The same as `nearest_known`, in plain numpy."""
    place, far = np.arange(len(known))[:, None], 2 * FAR
    above = np.maximum.accumulate(np.where(known, place, -far), axis=0)
    below = np.minimum.accumulate(np.where(known, place, far)[::-1], axis=0)[::-1]
    closest = np.where(place - above <= below - place, above, below)  # in each column
    closest = np.pad(closest, ((0, 0), (reach, reach)), constant_values=far)
    row, col, squared = np.zeros_like(rows), np.zeros_like(cols), np.full(len(rows), FAR * FAR)
    for offset in range(-reach, reach + 1):
        found = closest[rows, cols + offset + reach]
        apart = (found - rows) ** 2 + offset**2
        closer = apart < squared
        row[closer], col[closer], squared[closer] = found[closer], cols[closer] + offset, apart[closer]
    return row, col, np.sqrt(squared)
