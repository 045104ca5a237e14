"""Error metrics over arrays: heights, angles, aligned grids. Pure functions, no files.

Disparity: stereo_metrics.py; maps: terrain_metrics.py; poses: pose_metrics.py.

Metrics of many frames are kept as sums: a log of any length takes the memory of one frame, and every cell, not every
frame, counts the same. NaN is unknown and has no error. The share of an empty set is NaN.
"""

from __future__ import annotations

from typing import SupportsFloat

import numpy as np
from numpy.typing import ArrayLike

from stages.data import Array

MAX_CLOSE_ERROR = 0.05  # m, the height error that the Lunar Autonomy Challenge accepts
NMAD_SCALE = 1.4826  # from median deviation to standard deviation, for a normal distribution
NMAD_BIN = 1e-5  # m, to which errors are rounded for their median
MAX_NMAD_ERROR = 1.0  # m; larger errors share a bin


def share(part: SupportsFloat, whole: SupportsFloat) -> float:
    """part / whole; NaN for a whole of 0."""
    return float(part) / float(whole) if float(whole) else float("nan")


def in_ring(radius: Array, low: float, high: float) -> Array:
    """Mask of the radii in [low, high): a cell on the border of two rings belongs to the outer one."""
    return np.asarray((radius >= low) & (radius < high))


class HeightErrors:
    """Statistics of height errors of any number of cells, in the memory of one histogram.

    The NMAD is computed from errors rounded to 0.01 mm, which changes it by at most 0.015 mm. It is NaN if a median
    exceeds 1 m. All other metrics are exact.
    """

    def __init__(self) -> None:
        self.seen = self.cells = self.close = 0
        self.total = self.absolute = self.squares = 0.0
        self.half = round(MAX_NMAD_ERROR / NMAD_BIN)
        self.histogram = np.zeros(2 * self.half + 1, np.int64)

    def add(self, error: ArrayLike) -> None:
        """Count errors of any shape, m; NaN = an unknown cell."""
        values = np.asarray(error, np.float64).ravel()
        self.seen += values.size
        values = values[np.isfinite(values)]
        self.cells += values.size
        self.close += int(np.count_nonzero(np.abs(values) <= MAX_CLOSE_ERROR))
        self.total += float(values.sum())
        self.absolute += float(np.abs(values).sum())
        self.squares += float(np.square(values).sum())
        bins = np.rint(np.clip(values, -MAX_NMAD_ERROR, MAX_NMAD_ERROR) / NMAD_BIN).astype(np.int64) + self.half
        self.histogram += np.bincount(bins, minlength=self.histogram.size)

    def metrics(self) -> dict[str, float]:
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
        """NMAD_SCALE times the median distance from the median, both medians from histograms."""
        if not self.cells:
            return float("nan")
        low, high = _middles(self.histogram)
        middle = low + high  # in half bins, since the median may lie between two
        nearest, farthest = _middles(np.bincount(np.abs(2 * np.arange(2 * self.half + 1) - middle), self.histogram))
        # An end bin contains all larger errors, so no median may fall into one.
        if low == 0 or high == 2 * self.half or farthest >= 2 * self.half - abs(middle - 2 * self.half):
            return float("nan")
        return NMAD_SCALE * NMAD_BIN * (nearest + farthest) / 4


def _middles(counts: Array) -> tuple[int, int]:
    """The two middle values of a histogram, as indices; their mean is the median."""
    below = np.cumsum(counts)
    total = int(below[-1])
    low, high = np.searchsorted(below, [(total - 1) // 2, total // 2], side="right")
    return int(low), int(high)


def without_plane(x: Array, y: Array, error: Array) -> Array:
    """Errors minus their least-squares plane over (x, y), which removes an error of tilt and offset.

    error: (rows, cols) m; x: (cols,), y: (rows,) m. NaN errors stay NaN. With fewer than four known errors
    all become NaN.
    """
    known = np.isfinite(error)
    if np.count_nonzero(known) < 4:
        return np.full(error.shape, np.nan)
    east, north = np.meshgrid(x, y)
    design = np.column_stack([east.ravel(), north.ravel(), np.ones(east.size)])
    plane = np.linalg.lstsq(design[known.ravel()], error[known].astype(np.float64), rcond=None)[0]
    return np.asarray(error - (design @ plane).reshape(error.shape))


def angle_between(first: ArrayLike, second: ArrayLike) -> float:
    """Angle between two vectors (3,), rad, also exact for small angles."""
    a, b = np.asarray(first, np.float64), np.asarray(second, np.float64)
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def aligned(values: Array, origin: tuple[float, float], onto: tuple[int, int], onto_origin: tuple[float, float],
            resolution: float, missing: float) -> Array:  # fmt: skip
    """A grid moved onto the cells of another one of the same resolution; `missing` where it has none.

    values: (rows, cols); origin, onto_origin: (x, y) of the lower-left corners, m. Raises ValueError if the
    cells of the two grids differ by more than a hundredth of a cell.
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
