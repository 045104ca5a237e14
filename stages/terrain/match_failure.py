"""Why the pixels of a cell were not matched, from the gray values of the pixels that refinement filled.

A filled pixel has a guessed place and its own brightness. The guesses show that the cell is in the image, and the
brightness shows what hindered the match.
"""

from __future__ import annotations

import numpy as np

from stages.data import Array, MatchFailure, PointCloud
from stages.terrain.kernels.grid import Grid, cell_statistics

MAX_DARK = 32.0  # gray levels, an eighth of the range; unlit ground is darker
MIN_BURNT_OUT = 250.0  # gray levels
MAX_BARE_CONTRAST = 3.0  # gray levels RMS, about that of the noise
MIN_BARE_PIXELS = 4  # fewer have no contrast that could be measured


def match_failure(cloud: PointCloud, grid: Grid) -> Array:
    """Codes of `MatchFailure` of the cells that contain points of a cloud of filled pixels, (rows, cols) float64, else
    NaN."""
    shades = cloud.points.astype(np.float64)
    shades[:, 2] = cloud.colors @ np.ones(3) / 3
    figures = cell_statistics(shades, cloud.sigma, grid)
    found = figures[:, :, 0] > 0
    count, total, squares = figures[found, :3].T
    mean = total / count
    contrast = np.sqrt(np.maximum(squares / count - mean * mean, 0.0))
    bare = (contrast <= MAX_BARE_CONTRAST) & (count >= MIN_BARE_PIXELS)
    conditions = [mean <= MAX_DARK, mean >= MIN_BURNT_OUT, bare]
    causes = [MatchFailure.DARK, MatchFailure.BURNT_OUT, MatchFailure.BARE]
    codes = np.full(grid.shape, np.nan)
    codes[found] = np.select(conditions, [float(cause) for cause in causes], float(MatchFailure.OTHER))
    return codes
