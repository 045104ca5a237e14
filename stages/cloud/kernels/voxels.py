"""Counts and mean colours of occupied voxels.

A counting sort by column of voxels keeps the sums of one column at a time, so no table of all voxels is needed.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array


def voxel_means(points: Array, colors: Array, edge: float) -> tuple[Array, Array, Array]:
    """The occupied voxels of `edge` m; a voxel spans index * edge to (index + 1) * edge.

    points: (N, 3) float32, m, finite; colors: (N, 3) uint8. Returns index (M, 3) int32 in the order of y, x, z, the
    number of points (M,) int32, and their mean colour (M, 3) uint8, rounded down.
    """
    if not len(points):
        return np.zeros((0, 3), np.int32), np.zeros(0, np.int32), np.zeros((0, 3), np.uint8)
    index, count, total = _voxel_means(np.ascontiguousarray(points), np.ascontiguousarray(colors), edge)
    return index, count, (total // count[:, None]).astype(np.uint8)


@kernel
def _voxel_means(points, colors, edge):
    n = points.shape[0]
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for axis in range(3):  # numpy would take four times as long as the rest
        lowest = highest = points[0, axis]
        for i in range(n):
            lowest, highest = min(lowest, points[i, axis]), max(highest, points[i, axis])
        low[axis], high[axis] = int(np.floor(np.float64(lowest) / edge)), int(np.floor(np.float64(highest) / edge))
    cols, rows, levels = high[0] - low[0] + 1, high[1] - low[1] + 1, high[2] - low[2] + 1
    column, height = np.empty(n, np.int32), np.empty(n, np.int32)
    start = np.zeros(rows * cols + 1, np.int64)
    for i in range(n):
        col = int(np.floor(np.float64(points[i, 0]) / edge)) - low[0]
        row = int(np.floor(np.float64(points[i, 1]) / edge)) - low[1]
        column[i] = row * cols + col
        height[i] = int(np.floor(np.float64(points[i, 2]) / edge)) - low[2]
        start[column[i] + 1] += 1
    for k in range(rows * cols):
        start[k + 1] += start[k]
    order, end = np.empty(n, np.int32), start[:-1].copy()
    for i in range(n):
        order[end[column[i]]] = i
        end[column[i]] += 1
    index, count, total = np.empty((n, 3), np.int32), np.empty(n, np.int32), np.empty((n, 3), np.int32)
    sums = np.zeros((levels, 4), np.int32)  # of one column: points, red, green, blue
    found = 0
    for k in range(rows * cols):
        bottom, top = levels, -1
        for j in range(start[k], start[k + 1]):
            i = order[j]
            level = height[i]
            bottom, top = min(bottom, level), max(top, level)
            sums[level, 0] += 1
            for channel in range(3):
                sums[level, channel + 1] += colors[i, channel]
        for level in range(bottom, top + 1):
            if sums[level, 0]:
                index[found, 0], index[found, 1] = k % cols + low[0], k // cols + low[1]
                index[found, 2] = level + low[2]
                count[found] = sums[level, 0]
                total[found] = sums[level, 1:]
                sums[level] = 0
                found += 1
    return index[:found].copy(), count[:found].copy(), total[:found].copy()


def voxel_means_reference(points: Array, colors: Array, edge: float) -> tuple[Array, Array, Array]:
    """The same as `voxel_means`, in plain numpy."""
    voxels = np.floor(points.astype(np.float64) / edge).astype(np.int32)
    order, which, count = np.unique(voxels[:, [1, 0, 2]], axis=0, return_inverse=True, return_counts=True)
    which = which.ravel()
    total = np.stack([np.bincount(which, colors[:, c], minlength=len(order)) for c in range(3)], axis=1)
    return order[:, [1, 0, 2]], count.astype(np.int32), (total // count[:, None]).astype(np.uint8)
