"""Joint bilateral filter of a disparity image (paper, section 3.3): near in space, in gray level and in disparity.

Both range weights are Cauchy functions 1 / (1 + (difference / scale)^2) instead of Gaussians: no exponential in the
inner loop, which runs over whole rows with the tap's offset fixed. An unknown disparity is set to a value so distant
that its weight is negligible: 1e-30 of a neighbour's.

Texture makes the weights of a window lopsided, and on a surface that is seen at a slant their mean then lies beside the
pixel: it is off by 0.04 px on ground whose disparity grows by a quarter of a pixel per row. So a neighbour counts with
the disparity that the surface through it has at the pixel. Every other neighbour, as on a chessboard, does as well as
all. The filter of the paper has neither.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from stages.compiled.jit import fast_kernel, fast_part, kernel, part
from stages.compiled.parallel import by_bands, shared_by
from stages.data import Array

F32 = np.float32
GRAY_SCALE = 10.0  # levels; that of disparity is 1 px
UNKNOWN_VALUE = F32(1e15)  # px; its square is within float32
SLOPE_REACH, MAX_BEND = 5, 0.5  # px: a slope is that between pixels so far away, unless the surface bends by more


def joint_bilateral(disparity: Array, guide: Array, radius: int, threads: int = 1, plain: bool = False) -> Array:
    """Average each known disparity with its known neighbours; an unknown one (NaN) stays unknown.

    disparity: (H, W) float32, px, NaN = unknown; guide: (H, W) uint8; radius: px, > 0, also the standard deviation of
    the spatial Gaussian; plain: as in the paper, with all pixels of the window and as if no surface had a slope.
    Returns (H, W) float32.
    """
    height, filtered = disparity.shape[0], np.empty(disparity.shape, np.float32)
    values, levels, along, down = np.empty((4, *disparity.shape), np.float32)
    both, reach = shared_by(threads), 0 if plain else SLOPE_REACH
    by_bands(
        both, height, lambda first, end: _prepare(disparity, guide, reach, first, end, values, levels, along, down)
    )
    given = values, levels, along, down, _spatial(radius, plain)
    by_bands(both, height, lambda first, end: _filter(*given, first, end, filtered))
    by_bands(both, height, lambda first, end: _finish(disparity, first, end, filtered))
    return filtered


@cache
def _spatial(radius: int, plain: bool) -> Array:
    """Weight by distance, (2 radius + 1, 2 radius + 1) float32, 0 for the neighbours that do not count."""
    offsets = np.arange(-radius, radius + 1)
    counts = plain | ((offsets[:, None] + offsets) % 2 == 0)
    return np.where(counts, np.exp(-(offsets[:, None] ** 2 + offsets**2) / (2 * radius**2)), 0).astype(np.float32)


@kernel
def _prepare(disparity, guide, reach, first, end, values, levels, along, down):
    """values becomes the disparities, levels the guide divided by its scale, along and down the slopes."""
    height, width = disparity.shape
    for y in range(first, end):
        for x in range(width):
            here = disparity[y, x]
            values[y, x] = here if np.isfinite(here) else UNKNOWN_VALUE
            levels[y, x] = F32(guide[y, x]) * F32(1 / GRAY_SCALE)
            along[y, x] = down[y, x] = F32(0)
            if reach > 0 and reach <= y < height - reach:
                down[y, x] = _slope(disparity[y - reach, x], here, disparity[y + reach, x])
            if reach > 0 and reach <= x < width - reach:
                along[y, x] = _slope(disparity[y, x - reach], here, disparity[y, x + reach])


@part
def _slope(before, here, after):
    """The slope of a surface, 0 at an edge and where it is not known."""
    bend = abs(before + after - here - here)
    return (after - before) * F32(0.5 / SLOPE_REACH) if bend <= F32(MAX_BEND) else F32(0)


@kernel
def _finish(disparity, first, end, filtered):
    for y in range(first, end):
        for x in range(disparity.shape[1]):
            filtered[y, x] = filtered[y, x] if np.isfinite(disparity[y, x]) else F32(np.nan)


@fast_kernel
def _filter(values, levels, along, down, spatial, first, end, filtered):
    height, width = values.shape
    radius = spatial.shape[0] // 2
    sums, weights = np.empty(width, np.float32), np.empty(width, np.float32)
    for y in range(first, end):
        sums[:] = F32(0)
        weights[:] = F32(0)
        for below in range(max(-radius, -y), min(radius, height - 1 - y) + 1):
            for beside in range(max(-radius, 1 - width), min(radius, width - 1) + 1):
                tap, start = spatial[below + radius, beside + radius], max(0, -beside)
                if tap > 0:
                    _add(
                        values[y], values[y + below], levels[y], levels[y + below], along[y], down[y], F32(beside),
                        F32(below), np.uint64(start), np.uint64(start + beside), np.uint64(width - abs(beside)), tap,
                        sums, weights,
                    )  # fmt: skip
        for x in range(width):
            filtered[y, x] = sums[x] / weights[x]  # a pixel's own weight is 1


@fast_part
def _add(
    centres, values, levels, near_levels, along, down, beside, below, start, near, count, tap, sums, weights
):  # fmt: skip
    """Add one neighbour to each of `count` pixels: the first pixel is in column `start`, its neighbour in `near`."""
    for i in range(count):
        here, there = start + i, near + i
        value = values[there] - along[here] * beside - down[here] * below
        e, g = value - centres[here], near_levels[there] - levels[here]
        weight = tap / ((F32(1) + e * e) * (F32(1) + g * g))
        sums[here] += weight * value
        weights[here] += weight


def joint_bilateral_reference(disparity: Array, guide: Array, radius: int, plain: bool) -> Array:
    """`joint_bilateral` in plain numpy and float64."""
    height, width = disparity.shape
    values = np.pad(disparity.astype(np.float64), radius, constant_values=np.nan)
    levels = np.pad(guide.astype(np.float64), radius)
    down, along = (np.zeros((height, width)) if plain else _slopes_reference(disparity, axis) for axis in (0, 1))
    spatial = _spatial(radius, plain)
    sums, weights = np.zeros((height, width)), np.zeros((height, width))
    for below in range(2 * radius + 1):
        for beside in range(2 * radius + 1):
            near = values[below : below + height, beside : beside + width]
            near = near - along * (beside - radius) - down * (below - radius)
            near_gray = levels[below : below + height, beside : beside + width]
            weight = spatial[below, beside] / (1 + (near - disparity) ** 2)
            weight = weight / (1 + ((near_gray - guide) / GRAY_SCALE) ** 2)
            sums += np.where(np.isfinite(weight), weight * near, 0)
            weights += np.where(np.isfinite(weight), weight, 0)
    return np.where(np.isfinite(disparity), sums / np.where(weights > 0, weights, 1), np.nan).astype(np.float32)


def _slopes_reference(disparity: Array, axis: int) -> Array:
    wide = np.pad(disparity, SLOPE_REACH, constant_values=np.nan)
    inner = slice(SLOPE_REACH, -SLOPE_REACH)
    before, after = (np.roll(wide, shift, axis)[inner, inner] for shift in (SLOPE_REACH, -SLOPE_REACH))
    flat = np.abs(before + after - disparity - disparity) <= F32(MAX_BEND)
    return np.where(flat, (after - before) * F32(0.5 / SLOPE_REACH), 0)
