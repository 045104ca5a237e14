"""Error measures over arrays: heights, angles, grids laid over each other. Pure functions, no files.

What is summed over frames is kept as sums, so that a log of any length takes the memory of one frame and every cell,
not every frame, counts the same. NaN is "unknown" and never takes part in an error; shares of an empty set are NaN,
because there is nothing to say.
"""

from __future__ import annotations

from typing import SupportsFloat

import numpy as np
from numpy.typing import ArrayLike

from stages.data import Array, ElevationMap

CLOSE = 0.05  # m, the height error that the Lunar Autonomy Challenge accepts
NMAD_SCALE = 1.4826  # makes the median deviation of a normal distribution its standard deviation
NMAD_BIN = 1e-5  # m, to which errors are rounded for their median
NMAD_REACH = 1.0  # m, beyond which errors are one bin


def share(part: SupportsFloat, whole: SupportsFloat) -> float:
    """part / whole, NaN where there is no whole."""
    return float(part) / float(whole) if float(whole) else float("nan")


def cell_centres(grid: ElevationMap) -> tuple[Array, Array]:
    """x of each column (cols,) and y of each row (rows,) of a grid, m."""
    rows, cols = grid.shape
    left, bottom = grid.origin
    return left + (np.arange(cols) + 0.5) * grid.resolution, bottom + (np.arange(rows) + 0.5) * grid.resolution


def in_ring(radius: Array, low: float, high: float) -> Array:
    """Mask of the radii in [low, high): a cell on the border of two rings belongs to the outer one only."""
    return np.asarray((radius >= low) & (radius < high))


class HeightErrors:
    """Statistics of height errors of any number of cells, in the memory of one histogram.

    All but the NMAD come of exact sums. The NMAD comes of errors rounded to `NMAD_BIN` (0.01 mm), which moves it by
    0.015 mm at most; it is NaN where a median falls beyond `NMAD_REACH` (1 m).
    """

    def __init__(self) -> None:
        self.seen = self.cells = self.close = 0
        self.total = self.absolute = self.squares = 0.0
        self.half = round(NMAD_REACH / NMAD_BIN)
        self.histogram = np.zeros(2 * self.half + 1, np.int64)

    def add(self, error: ArrayLike) -> None:
        """Count errors of any shape, m; NaN = a cell that is seen and not known."""
        values = np.asarray(error, np.float64).ravel()
        self.seen += values.size
        values = values[np.isfinite(values)]
        self.cells += values.size
        self.close += int(np.count_nonzero(np.abs(values) <= CLOSE))
        self.total += float(values.sum())
        self.absolute += float(np.abs(values).sum())
        self.squares += float(np.square(values).sum())
        bins = np.rint(np.clip(values, -NMAD_REACH, NMAD_REACH) / NMAD_BIN).astype(np.int64) + self.half
        self.histogram += np.bincount(bins, minlength=self.histogram.size)

    def measures(self) -> dict[str, float]:
        """cells (known ones), rmse, mae, bias (mean), nmad, m; within_5cm (share)."""
        return {
            "cells": float(self.cells),
            "rmse": share(self.squares, self.cells) ** 0.5,
            "mae": share(self.absolute, self.cells),
            "bias": share(self.total, self.cells),
            "nmad": self._nmad(),
            "within_5cm": share(self.close, self.cells),
        }

    def _nmad(self) -> float:
        """NMAD_SCALE times the median distance from the median, both medians read off histograms."""
        if not self.cells:
            return float("nan")
        low, high = _middles(self.histogram)
        middle = low + high  # in half bins, since the median may lie between two
        nearest, farthest = _middles(np.bincount(np.abs(2 * np.arange(2 * self.half + 1) - middle), self.histogram))
        # An error in an end bin may be any larger one: neither median may be one of those.
        if low == 0 or high == 2 * self.half or farthest >= 2 * self.half - abs(middle - 2 * self.half):
            return float("nan")
        return NMAD_SCALE * NMAD_BIN * (nearest + farthest) / 4


def _middles(counts: Array) -> tuple[int, int]:
    """The two middle ones of the indices of `counts`, each taken that many times; their mean is the median."""
    below = np.cumsum(counts)
    total = int(below[-1])
    low, high = np.searchsorted(below, [(total - 1) // 2, total // 2], side="right")
    return int(low), int(high)


def without_plane(x: Array, y: Array, error: Array) -> Array:
    """Errors less their least-squares plane over (x, y): what is left when tilt and offset are forgiven.

    error: (rows, cols) m; x: (cols,), y: (rows,) m. NaN errors stay NaN and take no part. Fewer than four known errors
    leave nothing to compare, so all become NaN.
    """
    known = np.isfinite(error)
    if np.count_nonzero(known) < 4:
        return np.full(error.shape, np.nan)
    east, north = np.meshgrid(x, y)
    design = np.column_stack([east.ravel(), north.ravel(), np.ones(east.size)])
    plane = np.linalg.lstsq(design[known.ravel()], error[known].astype(np.float64), rcond=None)[0]
    return np.asarray(error - (design @ plane).reshape(error.shape))


def angle_between(first: ArrayLike, second: ArrayLike) -> float:
    """Angle between two vectors (3,), rad, exact for small angles too."""
    a, b = np.asarray(first, np.float64), np.asarray(second, np.float64)
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def aligned(values: Array, origin: tuple[float, float], onto: tuple[int, int], onto_origin: tuple[float, float],
            resolution: float, missing: float) -> Array:  # fmt: skip
    """A grid laid over another of equal resolution by whole cells: (rows, cols) of `onto`, `missing` where it has none.

    values: (rows, cols); origin, onto_origin: (x, y) of the lower-left corners, m. Raises ValueError where the two
    grids' cells do not coincide to a hundredth of a cell.
    """
    shift = [(mine - theirs) / resolution for mine, theirs in zip(origin, onto_origin, strict=True)]
    column, row = (round(cells) for cells in shift)
    if max(abs(shift[0] - column), abs(shift[1] - row)) > 0.01:
        raise ValueError(f"grid origins differ by a fraction of a {resolution:g} m cell")
    out = np.full(onto, missing, values.dtype)
    low_r, high_r = max(row, 0), min(row + values.shape[0], onto[0])
    low_c, high_c = max(column, 0), min(column + values.shape[1], onto[1])
    if low_r < high_r and low_c < high_c:
        out[low_r:high_r, low_c:high_c] = values[low_r - row : high_r - row, low_c - column : high_c - column]
    return out
