"""Fewer points with the same shape: the first point of each cube of a grid."""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import typed_kernel
from stages.data import Array, PointCloud

EMPTY = -1
FIRST_SLOTS = 1 << 12  # of the table, a power of 2
AXIS_BITS = 21  # of a cube's number along each axis


def thinned(cloud: PointCloud, spacing: float) -> PointCloud:
    """The first point, in the cloud's order, of each cube of `spacing` m; all points if that is 0."""
    return cloud.only(first_in_cubes(cloud.points, spacing)) if spacing else cloud


def first_in_cubes(points: Array, spacing: float) -> Array:
    """Indices (n,) int64 of the first point in each cube; points: (N, 3) float32, m; spacing: m, above 0."""
    return _first_in_cubes(points, 1 / spacing)


@typed_kernel
def _first_in_cubes(points: Array, scale: float) -> Array:
    """A table of the cubes found so far, open addressing; it doubles before it is half full."""
    kept = np.empty(points.shape[0], np.int64)
    table = np.full(FIRST_SLOTS, EMPTY, np.int64)
    found, mask = 0, FIRST_SLOTS - 1
    low = (1 << AXIS_BITS) - 1
    for i in range(points.shape[0]):
        key = 0
        for axis in range(3):
            key = key << AXIS_BITS | int(np.floor(points[i, axis] * scale)) & low
        slot = (key * 0x9E3779B97F4A7C1 >> 20) & mask
        while table[slot] != EMPTY and table[slot] != key:
            slot = (slot + 1) & mask
        if table[slot] == key:
            continue
        table[slot], kept[found] = key, i
        found += 1
        if 2 * found > mask:
            larger, mask = np.full(2 * (mask + 1), EMPTY, np.int64), 2 * mask + 1
            for place in range(table.size):
                if table[place] != EMPTY:
                    slot = (int(table[place]) * 0x9E3779B97F4A7C1 >> 20) & mask
                    while larger[slot] != EMPTY:
                        slot = (slot + 1) & mask
                    larger[slot] = table[place]
            table = larger
    return kept[:found].copy()


def first_in_cubes_reference(points: Array, spacing: float) -> Array:
    """`first_in_cubes` in plain numpy."""
    cubes = np.floor(points.astype(np.float64) * (1 / spacing)).astype(np.int64)
    return np.sort(np.unique(cubes, axis=0, return_index=True)[1])
