"""Speckle removal: patches of the disparity image that are too small to be believed are dropped.

A patch is a set of pixels joined through neighbours (left, right, above, below) whose disparities differ by no more
than `step`. The trick: what is joined are not pixels but runs, stretches of a row without such a step, by union-find;
a row has a hundred times fewer of them, and a patch is dropped run by run.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from stages.data import Array
from stages.kernels.compiled import kernel
from stages.kernels.halves import in_turn
from stages.kernels.union import join, root


def drop_speckles(
    disparity: Array, evidence: Array, step: float, largest: int, at_once: Callable[..., object] = in_turn
) -> None:
    """Set patches of at most `largest` pixels to NaN, and their evidence to 0, in place.

    disparity: (H, W) float32, px, NaN = unknown; evidence: (H, W) uint8; step: px; at_once: calls two functions, one
    for the upper and one for the lower half of the image.
    """
    if largest == 0:
        return
    height, columns = disparity.shape
    middle = height // 2
    # As many runs as pixels at most. What is not touched never becomes memory.
    start, end, parent = (np.empty(height * columns, np.int32) for _ in range(3))
    seam = np.full((2, columns), -1, np.int32)
    runs, limit = (start, end, parent), np.float32(step)
    counts = np.array([0, middle * columns])

    def find(first: int, last: int, half: int) -> None:
        rows = np.full((2, columns), -1, np.int32), np.zeros((2, columns + 1), np.bool_)
        _find_runs(disparity, first, last, limit, runs, counts, seam, half, *rows)

    at_once(lambda: find(0, middle, 0), lambda: find(middle, height, 1))
    _drop(disparity, evidence, middle, limit, largest, runs, np.zeros(height * columns, np.int32), counts, seam)


@kernel
def _find_runs(disparity, first_row, end_row, step, runs, counts, seam, half, ids, links):  # type: ignore[no-untyped-def]
    """Runs of some rows, joined among themselves; `seam` takes those of the row next to the other half."""
    start, end, parent = runs
    columns = disparity.shape[1]
    count = counts[half]
    beside, over = links[0], links[1]  # whether a pixel belongs to the patch of its left or of its upper neighbour
    for y in range(first_row, end_row):
        row, last = disparity[y], disparity[max(y - 1, 0)]
        above, here = ids[(y + 1) & 1], ids[y & 1]
        for x in range(1, columns):
            beside[x] = abs(row[x] - row[x - 1]) <= step
        for x in range(columns):
            over[x] = abs(row[x] - last[x]) <= step
            here[x] = -1
        x = 0
        while x < columns:
            if row[x] != row[x]:
                x += 1
                continue
            first = x
            x += 1
            while beside[x]:  # ends at the row's end, where there is always False
                x += 1
            start[count], end[count], parent[count] = y * columns + first, y * columns + x, count
            joined = -1  # the run above that this one was joined with last
            for i in range(first, x):
                here[i] = count
                if over[i] and above[i] != joined:
                    joined = above[i]
                    if joined >= 0:
                        join(parent, count, joined)
            count += 1
        if y == (end_row - 1 if half == 0 else first_row):
            for x in range(columns):
                seam[half, x] = here[x]
    counts[half] = count


@kernel
def _drop(disparity, evidence, middle, step, largest, runs, area, counts, seam):  # type: ignore[no-untyped-def]
    start, end, parent = runs
    columns = disparity.shape[1]
    for x in range(columns):
        if seam[0, x] >= 0 and seam[1, x] >= 0 and abs(disparity[middle, x] - disparity[middle - 1, x]) <= step:
            join(parent, seam[0, x], seam[1, x])
    for first, count in ((0, counts[0]), (middle * columns, counts[1])):
        for run in range(first, count):
            area[root(parent, run)] += end[run] - start[run]
    pixels, strength = disparity.reshape(-1), evidence.reshape(-1)
    for first, count in ((0, counts[0]), (middle * columns, counts[1])):
        for run in range(first, count):
            if area[root(parent, run)] <= largest:
                for i in range(start[run], end[run]):
                    pixels[i], strength[i] = np.nan, 0


def drop_speckles_reference(disparity: Array, evidence: Array, step: float, largest: int) -> None:
    """`drop_speckles` by the connected components of a graph of pixels."""
    index = np.arange(disparity.size).reshape(disparity.shape)
    with np.errstate(invalid="ignore"):
        beside = np.abs(np.diff(disparity, axis=1)) <= np.float32(step)
        above = np.abs(np.diff(disparity, axis=0)) <= np.float32(step)
    first = np.concatenate([index[:, :-1][beside], index[:-1][above]])
    second = np.concatenate([index[:, 1:][beside], index[1:][above]])
    graph = coo_array((np.ones(len(first), np.uint8), (first, second)), shape=(index.size, index.size))
    labels = connected_components(graph, directed=False)[1].reshape(disparity.shape)
    small = (np.bincount(labels.ravel())[labels] <= largest) & np.isfinite(disparity)
    disparity[small], evidence[small] = np.nan, 0
