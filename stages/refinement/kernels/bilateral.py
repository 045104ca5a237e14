"""Joint bilateral filter of a disparity image (paper, section 3.3): near in space, in gray level and in disparity.

Both range weights are Cauchy functions 1 / (1 + (difference / scale)^2) instead of Gaussians: no exponential in the
inner loop, which runs over whole rows with the tap's offset fixed. An unknown disparity is set to a value so distant
that its weight is negligible: 1e-30 of a neighbour's. Every other neighbour, as on a chessboard, does as well as all.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from stages.compiled.jit import fast_kernel, fast_part, kernel
from stages.compiled.parallel import by_bands, shared_by
from stages.data import Array

F32 = np.float32
GRAY_SCALE = 10.0  # levels; that of disparity is 1 px
UNKNOWN_VALUE = F32(1e15)  # px; its square is within float32


def joint_bilateral(disparity: Array, guide: Array, radius: int, threads: int = 1, every: bool = False) -> Array:
    """Average each known disparity with its known neighbours; an unknown one (NaN) stays unknown.

    disparity: (H, W) float32, px, NaN = unknown; guide: (H, W) uint8; radius: px, > 0, also the standard deviation of
    the spatial Gaussian; every: whether all pixels of the window count, not only those on the chessboard. Returns
    (H, W) float32.
    """
    height, filtered = disparity.shape[0], np.empty(disparity.shape, np.float32)
    values, levels = np.empty((2, *disparity.shape), np.float32)
    both = shared_by(threads)
    by_bands(both, height, lambda first, end: _prepare(disparity, guide, first, end, values, levels))
    given = values, levels, _spatial(radius, every)
    by_bands(both, height, lambda first, end: _filter(*given, first, end, filtered))
    by_bands(both, height, lambda first, end: _finish(disparity, first, end, filtered))
    return filtered


@cache
def _spatial(radius: int, every: bool) -> Array:
    """Weight by distance, (2 radius + 1, 2 radius + 1) float32, 0 for the neighbours that do not count."""
    offsets = np.arange(-radius, radius + 1)
    counts = every | ((offsets[:, None] + offsets) % 2 == 0)
    return np.where(counts, np.exp(-(offsets[:, None] ** 2 + offsets**2) / (2 * radius**2)), 0).astype(np.float32)


@kernel
def _prepare(disparity, guide, first, end, values, levels):
    """values becomes the disparities, levels the guide divided by its scale."""
    for y in range(first, end):
        for x in range(disparity.shape[1]):
            values[y, x] = disparity[y, x] if np.isfinite(disparity[y, x]) else UNKNOWN_VALUE
            levels[y, x] = F32(guide[y, x]) * F32(1 / GRAY_SCALE)


@kernel
def _finish(disparity, first, end, filtered):
    for y in range(first, end):
        for x in range(disparity.shape[1]):
            filtered[y, x] = filtered[y, x] if np.isfinite(disparity[y, x]) else F32(np.nan)


@fast_kernel
def _filter(values, levels, spatial, first, end, filtered):
    height, width = values.shape
    radius = spatial.shape[0] // 2
    sums, weights = np.empty(width, np.float32), np.empty(width, np.float32)
    for y in range(first, end):
        sums[:] = F32(0)
        weights[:] = F32(0)
        for down in range(max(-radius, -y), min(radius, height - 1 - y) + 1):
            for across in range(max(-radius, 1 - width), min(radius, width - 1) + 1):
                tap, start = spatial[down + radius, across + radius], max(0, -across)
                if tap > 0:
                    _add(
                        values[y], values[y + down], levels[y], levels[y + down], np.uint64(start),
                        np.uint64(start + across), np.uint64(width - abs(across)), tap, sums, weights,
                    )  # fmt: skip
        for x in range(width):
            filtered[y, x] = sums[x] / weights[x]  # a pixel's own weight is 1


@fast_part
def _add(centres, values, levels, near_levels, start, near, count, tap, sums, weights):
    """Add one neighbour to each of `count` pixels: the first pixel is in column `start`, its neighbour in `near`."""
    for i in range(count):
        here, there = start + i, near + i
        e, g = values[there] - centres[here], near_levels[there] - levels[here]
        weight = tap / ((F32(1) + e * e) * (F32(1) + g * g))
        sums[here] += weight * values[there]
        weights[here] += weight


def joint_bilateral_reference(disparity: Array, guide: Array, radius: int, every: bool) -> Array:
    """`joint_bilateral` in plain numpy and float64."""
    height, width = disparity.shape
    values = np.pad(disparity.astype(np.float64), radius, constant_values=np.nan)
    levels = np.pad(guide.astype(np.float64), radius)
    spatial = _spatial(radius, every)
    sums, weights = np.zeros((height, width)), np.zeros((height, width))
    for down in range(2 * radius + 1):
        for across in range(2 * radius + 1):
            near = values[down : down + height, across : across + width]
            near_gray = levels[down : down + height, across : across + width]
            weight = spatial[down, across] / (1 + (near - disparity) ** 2)
            weight = weight / (1 + ((near_gray - guide) / GRAY_SCALE) ** 2)
            sums += np.where(np.isfinite(weight), weight * near, 0)
            weights += np.where(np.isfinite(weight), weight, 0)
    return np.where(np.isfinite(disparity), sums / np.where(weights > 0, weights, 1), np.nan).astype(np.float32)
