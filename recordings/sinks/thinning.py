"""Fewer points with the same shape: the first point of each cube of a grid."""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import borrowing_kernel, typed_kernel
from stages.data import Array, PointCloud

EMPTY = -1
FIRST_SLOTS = 1 << 12  # of the table, a power of 2
AXIS_BITS = 19  # of a block's number along each axis
BLOCK_BITS = 2  # a block has 1 << BLOCK_BITS cubes along each axis: one bit of 64 for each of its cubes


def thinned(cloud: PointCloud, spacing: float) -> PointCloud:
    """The first point, in the cloud's order, of each cube of `spacing` m; all points if that is 0."""
    return cloud.only(first_in_cubes(cloud.points, spacing)) if spacing else cloud


def first_in_cubes(points: Array, spacing: float) -> Array:
    """Indices (n,) int64 of the first point in each cube; points: (N, 3) float32, m; spacing: m, above 0."""
    return _first_in_cubes(points, 1 / spacing)


@typed_kernel
def _first_in_cubes(points: Array, scale: float) -> Array:
    """A table of blocks of 4 x 4 x 4 cubes, open addressing; it doubles before it is half full."""
    kept, counts = np.empty(points.shape[0], np.int32), np.zeros(2, np.int64)
    table, cubes = np.full(FIRST_SLOTS, EMPTY, np.int64), np.zeros(FIRST_SLOTS, np.uint64)
    start = _fill(points, scale, 0, table, cubes, kept, counts)
    while start < points.shape[0]:
        table, cubes = _doubled(table, cubes)
        start = _fill(points, scale, start, table, cubes, kept, counts)
    return kept[: counts[0]].astype(np.int64)


@borrowing_kernel
def _fill(points: Array, scale: float, start: int, table: Array, cubes: Array, kept: Array, counts: Array) -> int:
    """Take points from `start` on until the table is half full; returns the first point that was not taken.

    counts: the kept points and the blocks so far. Neighbouring points are in the same block mostly, which is then not
    looked up again.
    """
    low, inside = (1 << AXIS_BITS) - 1, (1 << BLOCK_BITS) - 1
    found, blocks, last, slot = counts[0], counts[1], EMPTY, 0
    for i in range(start, points.shape[0]):
        key, cube = 0, 0
        for axis in range(3):
            number = int(np.floor(points[i, axis] * scale))
            key = key << AXIS_BITS | number >> BLOCK_BITS & low
            cube = cube << BLOCK_BITS | number & inside
        if key != last:
            slot = _slot(table, key)
            if table[slot] == EMPTY:
                if 2 * blocks > table.size:
                    counts[0], counts[1] = found, blocks
                    return i
                table[slot], blocks = key, blocks + 1
            last = key
        bit = np.uint64(1) << np.uint64(cube)
        if not cubes[slot] & bit:
            cubes[slot] |= bit
            kept[found] = i
            found += 1
    counts[0], counts[1] = found, blocks
    return len(points)


@borrowing_kernel
def _slot(table: Array, key: int) -> int:
    """The place of a block in a table: its own, or the first free one."""
    mask = table.size - 1
    slot = int(np.uint64(key) * np.uint64(0x9E3779B97F4A7C15) >> np.uint64(40)) & mask  # all bits of the key count
    while table[slot] != EMPTY and table[slot] != key:
        slot = (slot + 1) & mask
    return slot


@typed_kernel
def _doubled(table: Array, cubes: Array) -> tuple[Array, Array]:
    """The same blocks in a table of twice the size."""
    larger, moved = np.full(2 * table.size, EMPTY, np.int64), np.zeros(2 * table.size, np.uint64)
    for place in range(table.size):
        if table[place] != EMPTY:
            slot = _slot(larger, table[place])
            larger[slot], moved[slot] = table[place], cubes[place]
    return larger, moved


def first_in_cubes_reference(points: Array, spacing: float) -> Array:
    """`first_in_cubes` in plain numpy."""
    cubes = np.floor(points.astype(np.float64) * (1 / spacing)).astype(np.int64)
    return np.sort(np.unique(cubes, axis=0, return_index=True)[1])
