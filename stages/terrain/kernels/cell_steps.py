"""How far each cell stands out of its surroundings: the largest of four heights."""

from __future__ import annotations

from functools import reduce

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array

MAX_EXTREME = 4.0  # how far an extreme counts, over the mean: one stray point is no step


def cell_steps(
    height: Array, observed: Array, top: Array, bottom: Array, lowest: Array, ground: Array, trend: Array
) -> Array:
    """Rise over the lowest neighbour, height over and depth under the ground, and rise within the cell: the largest, m.

    height: (rows, cols) float64, m; observed: (rows, cols) bool, the cells that count; top, bottom: (rows, cols)
    float32, extremes of the cell's heights, m, the height where they are not finite; lowest: of `local_minimum`;
    ground: (rows, cols) float64, m, NaN where unknown; trend: (2, rows, cols) float64, m per cell. Returns (rows, cols)
    float64, NaN in cells that do not count.
    """
    steps = np.full(height.shape, np.nan)
    arguments = height, observed, top, bottom, lowest, ground, trend
    _cell_steps(*(np.ascontiguousarray(argument) for argument in arguments), steps)
    return steps


@kernel
def _cell_steps(height, observed, top, bottom, lowest, ground, trend, steps):
    for row in range(height.shape[0]):
        for col in range(height.shape[1]):
            if not observed[row, col]:
                continue
            here, level = height[row, col], ground[row, col]
            high = np.float64(top[row, col]) if np.isfinite(top[row, col]) else here
            low = np.float64(bottom[row, col]) if np.isfinite(bottom[row, col]) else here
            rise = min(high - lowest[row, col], MAX_EXTREME * (here - lowest[row, col]))
            explained = abs(trend[0, row, col]) + abs(trend[1, row, col])  # from one corner to the opposite one
            within = min(high - low - explained, MAX_EXTREME * min(here - low, high - here))
            step = max(rise, within, 0.0)
            if not np.isnan(level):
                step = max(step, min(high - level, MAX_EXTREME * (here - level)))
                step = max(step, min(level - low, MAX_EXTREME * (level - here)))
            steps[row, col] = step


def cell_steps_reference(
    height: Array, observed: Array, top: Array, bottom: Array, lowest: Array, ground: Array, trend: Array
) -> Array:
    """The same as `cell_steps`, in plain numpy."""
    top, bottom = (np.where(np.isfinite(layer), layer, height) for layer in (top, bottom))
    rise = np.minimum(top - lowest, MAX_EXTREME * (height - lowest))
    above = np.minimum(top - ground, MAX_EXTREME * (height - ground))
    below = np.minimum(ground - bottom, MAX_EXTREME * (ground - height))
    within = np.minimum(
        top - bottom - np.abs(trend).sum(axis=0), MAX_EXTREME * np.minimum(height - bottom, top - height)
    )
    return np.where(observed, reduce(np.fmax, [rise, above, below, within, np.zeros_like(height)]), np.nan)
