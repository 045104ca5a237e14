"""Joint bilateral filter of a disparity image (paper, section 3.3): near in space, in gray level and in disparity.

Both range weights are Cauchy functions 1 / (1 + (difference / scale)^2) instead of Gaussians: no exponential in the
inner loop, which runs over whole rows with the tap's offset fixed.
"""

from __future__ import annotations

import numpy as np

from stages.data import Array
from stages.kernels.compiled import fast_kernel, kernel
from stages.kernels.halves import by_halves, shared_by

F32 = np.float32


def joint_bilateral(
    disparity: Array, guide: Array, radius: int, space: float, gray: float, range_scale: float, threads: int = 1
) -> Array:
    """Average each known disparity with its known neighbours; an unknown one (NaN) stays unknown.

    disparity: (H, W) float32, px, NaN = unknown; guide: (H, W) uint8; radius: px; space: standard deviation of the
    spatial Gaussian, px; gray: scale of the difference in the guide, levels; range_scale: scale of the difference in
    disparity, px; threads: 2 share the work. Returns (H, W) float32.
    """
    height, filtered = disparity.shape[0], np.empty(disparity.shape, np.float32)
    values, known, levels = np.empty((3, *disparity.shape), np.float32)
    given = values, known, levels, radius, _spatial(radius, space), F32(1 / gray), F32(1 / range_scale)
    both = shared_by(threads)
    by_halves(both, height, lambda first, end: _prepare(disparity, guide, values, known, levels, first, end))
    by_halves(both, height, lambda first, end: _filter(*given, first, end, filtered))
    by_halves(both, height, lambda first, end: _forget(disparity, first, end, filtered))
    return filtered


def _spatial(radius: int, space: float) -> Array:
    offsets = np.arange(-radius, radius + 1) / space
    return np.exp(-(offsets[:, None] ** 2 + offsets**2) / 2).astype(np.float32)


@kernel
def _prepare(disparity, guide, values, known, levels, first, end):  # type: ignore[no-untyped-def]
    """values: the disparities, 0 where unknown; known: 1 or 0; levels: the guide."""
    for y in range(first, end):
        for x in range(disparity.shape[1]):
            finite = np.isfinite(disparity[y, x])
            values[y, x] = disparity[y, x] if finite else F32(0)
            known[y, x] = F32(1) if finite else F32(0)
            levels[y, x] = guide[y, x]


@kernel
def _forget(disparity, first, end, filtered):  # type: ignore[no-untyped-def]
    for y in range(first, end):
        for x in range(disparity.shape[1]):
            filtered[y, x] = filtered[y, x] if np.isfinite(disparity[y, x]) else F32(np.nan)


@fast_kernel
def _filter(values, known, guide, radius, spatial, per_gray, per_pixel, first, end, filtered):  # type: ignore[no-untyped-def]
    height, width = values.shape
    sums, weights = np.empty(width, np.float32), np.empty(width, np.float32)
    for y in range(first, end):
        sums[:] = F32(0)
        weights[:] = F32(0)
        for down in range(max(-radius, -y), min(radius, height - 1 - y) + 1):
            for across in range(max(-radius, 1 - width), min(radius, width - 1) + 1):
                tap = spatial[down + radius, across + radius]
                start, stop = max(0, -across), min(width, width - across)
                centre, near = values[y, start:stop], values[y + down, start + across : stop + across]
                gray, near_gray = guide[y, start:stop], guide[y + down, start + across : stop + across]
                near_known = known[y + down, start + across : stop + across]
                s, w = sums[start:stop], weights[start:stop]
                for i in range(stop - start):
                    e = (near[i] - centre[i]) * per_pixel
                    g = (near_gray[i] - gray[i]) * per_gray
                    weight = tap * near_known[i] / ((F32(1) + e * e) * (F32(1) + g * g))
                    s[i] += weight * near[i]
                    w[i] += weight
        for x in range(width):
            filtered[y, x] = sums[x] / weights[x] if weights[x] > F32(0) else F32(0)


def joint_bilateral_reference(
    disparity: Array, guide: Array, radius: int, space: float, gray: float, range_scale: float
) -> Array:
    """`joint_bilateral` in plain numpy and float64."""
    height, width = disparity.shape
    values = np.pad(disparity.astype(np.float64), radius, constant_values=np.nan)
    levels = np.pad(guide.astype(np.float64), radius)
    spatial = _spatial(radius, space)
    sums, weights = np.zeros((height, width)), np.zeros((height, width))
    for down in range(2 * radius + 1):
        for across in range(2 * radius + 1):
            near = values[down : down + height, across : across + width]
            near_gray = levels[down : down + height, across : across + width]
            weight = spatial[down, across] / (1 + ((near - disparity) / range_scale) ** 2)
            weight = weight / (1 + ((near_gray - guide) / gray) ** 2)
            sums += np.where(np.isfinite(weight), weight * near, 0)
            weights += np.where(np.isfinite(weight), weight, 0)
    return np.where(np.isfinite(disparity), sums / np.where(weights > 0, weights, 1), np.nan).astype(np.float32)
