"""Speckle removal: small isolated patches of the disparity image are dropped.

A patch is a set of pixels joined through neighbours (left, right, above, below) whose disparities differ by at most 1
px. The trick: union-find joins runs, stretches of a row without a larger step, instead of pixels. A row has a hundred
times fewer runs than pixels, and a patch is dropped run by run.
"""

from __future__ import annotations

import itertools

import numpy as np

from stages.compiled.jit import kernel
from stages.compiled.parallel import Fork, by_bands, in_turn
from stages.compiled.union_find import join, root
from stages.compiled.workspace import Workspace
from stages.data import Array, PixelOrigin

SPECKLE = int(PixelOrigin.SPECKLE)
STEP = np.float32(1)  # px, of disparity between two pixels of a patch


def drop_speckles(
    disparity: Array, evidence: Array, source: Array, max_size: int, space: Workspace, run_both: Fork = in_turn
) -> None:  # fmt: skip
    """Set patches of at most `max_size` pixels to NaN, their evidence to 0 and their source to SPECKLE, in place.

    disparity: (H, W) float32, px, NaN = unknown; evidence, source: (H, W) uint8; space: memory for the runs; run_both:
    calls two functions, on one thread or two.
    """
    if max_size == 0:
        return
    columns = disparity.shape[1]
    space.reserve(4 * (4 * disparity.size + 64))
    # There are at most as many runs as pixels. Pages that are not touched take no memory.
    runs = tuple(space.array((disparity.size,), np.int32) for _ in ("start", "end", "parent", "area"))
    bands = dict[int, tuple[int, Array]]()  # first row -> end of the runs; the runs of its first and last row

    def find(first: int, end: int) -> None:
        seams, goes_on = np.full((2, columns), -1, np.int32), np.zeros(columns + 1, np.bool_)
        bands[first] = _find_runs(disparity, first, end, runs, seams, goes_on), seams

    def drop(first: int, _: int) -> None:
        layers = disparity.reshape(-1), evidence.reshape(-1), source.reshape(-1)
        _drop(*layers, runs, first * columns, bands[first][0], max_size)

    by_bands(run_both, len(disparity), find)
    for upper, lower in itertools.pairwise(sorted(bands)):
        _join_bands(disparity, lower, runs, bands[upper][1][1], bands[lower][1][0])
    by_bands(run_both, len(disparity), drop)


@kernel
def _find_runs(disparity, first_row, end_row, runs, seams, goes_on):
    """Write the runs of some rows, joined with each other, from index first_row * W on; return the end index.

    A run that is its own parent has the area of its patch, in pixels.
    seams: (2, W), all -1, receives the runs of the first and the last row, pixel by pixel; goes_on: (W + 1,) bool,
    False at both ends.
    """
    start, end, parent, area = runs
    pixels, columns = disparity.reshape(-1), disparity.shape[1]
    begin = first_row * columns
    count = above = begin
    for y in range(first_row, end_row):
        row, origin, above_end = disparity[y], y * columns, count
        for x in range(1, columns):
            goes_on[x] = abs(row[x] - row[x - 1]) <= STEP
        x = 0
        while x < columns:
            first = x
            x += 1
            if row[first] != row[first]:
                continue
            while goes_on[x]:  # False at the end of the row
                x += 1
            start[count], end[count], parent[count], area[count] = origin + first, origin + x, count, x - first
            while above < above_end and end[above] + columns <= start[count]:
                above += 1
            other = above
            while other < above_end and start[other] + columns < end[count]:
                for i in range(max(start[other] + columns, start[count]), min(end[other] + columns, end[count])):
                    if abs(pixels[i] - pixels[i - columns]) <= STEP:
                        join(parent, count, other)
                        break
                other += 1
            if y == first_row:
                seams[0, first:x] = count
            if y == end_row - 1:
                seams[1, first:x] = count
            count += 1
        above = above_end
    for run in range(begin, count):
        parent[run] = root(parent, run)
        if parent[run] != run:
            area[parent[run]] += area[run]
    return count


@kernel
def _join_bands(disparity, y, runs, above, below):
    """Join the runs of row y - 1, `above`, and of row y, `below`, pixel by pixel."""
    _, _, parent, area = runs
    for x in range(disparity.shape[1]):
        if above[x] >= 0 and below[x] >= 0 and abs(disparity[y, x] - disparity[y - 1, x]) <= STEP:
            upper, lower = root(parent, above[x]), root(parent, below[x])
            if upper != lower:
                join(parent, upper, lower)
                area[min(upper, lower)] += area[max(upper, lower)]


@kernel
def _drop(pixels, strength, source, runs, first, last, max_size):
    start, end, parent, area = runs
    for run in range(first, last):
        patch = run
        while parent[patch] != patch:  # two threads read at once: no path halving
            patch = parent[patch]
        if area[patch] <= max_size:
            for i in range(start[run], end[run]):
                pixels[i], strength[i], source[i] = np.nan, 0, SPECKLE


def drop_speckles_reference(disparity: Array, evidence: Array, source: Array, max_size: int) -> None:
    """`drop_speckles` by the connected components of a graph of pixels."""
    from scipy.sparse import coo_array  # takes long to import
    from scipy.sparse.csgraph import connected_components

    index = np.arange(disparity.size).reshape(disparity.shape)
    with np.errstate(invalid="ignore"):
        beside = np.abs(np.diff(disparity, axis=1)) <= STEP
        above = np.abs(np.diff(disparity, axis=0)) <= STEP
    first = np.concatenate([index[:, :-1][beside], index[:-1][above]])
    second = np.concatenate([index[:, 1:][beside], index[1:][above]])
    graph = coo_array((np.ones(len(first), np.uint8), (first, second)), shape=(index.size, index.size))
    labels = connected_components(graph, directed=False)[1].reshape(disparity.shape)
    small = (np.bincount(labels.ravel())[labels] <= max_size) & np.isfinite(disparity)
    disparity[small], evidence[small], source[small] = np.nan, 0, SPECKLE
