"""Error measures over arrays: disparity, elevation, hazards, rocks, tilt. Pure functions, no files.

NaN is "unknown" and never takes part in an error; shares of an empty set are NaN, because there is nothing to say.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import SupportsFloat

import numpy as np
from numpy.typing import ArrayLike

from stages.data import Array, Cell

BAD_THRESHOLDS = (0.5, 1.0, 2.0)  # px
CLOSE = 0.05  # m, the height error that the Lunar Autonomy Challenge accepts
NMAD_SCALE = 1.4826  # makes the median deviation of a normal distribution its standard deviation


def share(part: SupportsFloat, whole: SupportsFloat) -> float:
    """part / whole, NaN where there is no whole."""
    return float(part) / float(whole) if float(whole) else float("nan")


def disparity_measures(estimate: Array, truth: Array, counted: Array) -> dict[str, float]:
    """Disparity errors over the pixels of the mask `counted` (H, W) that have a true value.

    estimate, truth: (H, W) px, NaN = unknown. Returns pixels (how many were counted), density (share of them known),
    bad_T (share in error by more than T px, an unknown pixel being bad), bad_T_known (of the known ones), mae and rmse
    (px, of the known ones).
    """
    counted = counted & np.isfinite(truth)
    error = np.abs(np.asarray(estimate, np.float64)[counted] - np.asarray(truth, np.float64)[counted])
    known = error[np.isfinite(error)]
    measures = {"pixels": float(error.size), "density": share(known.size, error.size)}
    for limit in BAD_THRESHOLDS:
        over = int(np.count_nonzero(known > limit))
        measures[f"bad_{limit:g}"] = share(over + error.size - known.size, error.size)
        measures[f"bad_{limit:g}_known"] = share(over, known.size)
    measures["mae"] = float(known.mean()) if known.size else float("nan")
    measures["rmse"] = float(np.sqrt(np.mean(known**2))) if known.size else float("nan")
    return measures


def pooled_disparity(frames: Sequence[dict[str, float]]) -> dict[str, float]:
    """`disparity_measures` of several frames as one: every pixel, not every frame, counts the same."""
    counts = np.array([frame["pixels"] for frame in frames])
    known = np.array([frame["pixels"] * frame["density"] if frame["pixels"] else 0.0 for frame in frames])
    pooled = {"pixels": float(counts.sum()), "density": share(known.sum(), counts.sum())}
    for name in frames[0]:
        if name in pooled:
            continue
        weight = counts if name.startswith("bad_") and not name.endswith("_known") else known
        power = 2 if name == "rmse" else 1
        values = np.array([frame[name] for frame in frames])
        total = np.sum((weight * values**power)[weight > 0])
        pooled[name] = share(total, weight.sum()) ** (1 / power)
    return pooled


def height_measures(error: ArrayLike) -> dict[str, float]:
    """Statistics of height errors (N,), m, NaN left out: cells, rmse, mae, bias (mean), nmad, within_5cm (share)."""
    values = np.asarray(error, np.float64).ravel()
    values = values[np.isfinite(values)]
    if not values.size:
        return {"cells": 0.0, **dict.fromkeys(("rmse", "mae", "bias", "nmad", "within_5cm"), float("nan"))}
    return {
        "cells": float(values.size),
        "rmse": float(np.sqrt(np.mean(values**2))),
        "mae": float(np.abs(values).mean()),
        "bias": float(values.mean()),
        "nmad": NMAD_SCALE * float(np.median(np.abs(values - np.median(values)))),
        "within_5cm": share(np.count_nonzero(np.abs(values) <= CLOSE), values.size),
    }


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


def hazard_measures(cells: Array, truth: Array, counted: Array) -> dict[str, float]:
    """How well a map of `Cell` codes finds the hazards, over the cells of the mask `counted`; any one shape.

    Returns cells, unknown (share), recall (of true hazards, called hazard), false_safe (of true hazards, called free),
    false_alarm (of truly free cells, called hazard).
    """
    told, true = cells[counted], truth[counted]
    hazard, free = true == Cell.HAZARD, true == Cell.FREE
    return {
        "cells": float(told.size),
        "unknown": share(np.count_nonzero(told == Cell.UNKNOWN), told.size),
        "recall": share(np.count_nonzero(hazard & (told == Cell.HAZARD)), np.count_nonzero(hazard)),
        "false_safe": share(np.count_nonzero(hazard & (told == Cell.FREE)), np.count_nonzero(hazard)),
        "false_alarm": share(np.count_nonzero(free & (told == Cell.HAZARD)), np.count_nonzero(free)),
    }


def rocks_found(
    rocks: Array, cells: Array, visible: Array, x: Array, y: Array, resolution: float
) -> tuple[Array, Array]:
    """Which rocks could be seen, and which of them the map calls a hazard; two bool (N,).

    rocks: (N, 3) x, y, diameter, m; cells: (rows, cols) `Cell` codes; visible: (rows, cols) bool; x, y: (cols,) and
    (rows,) cell centres, m. A rock can be seen if a visible cell's centre lies within its radius (or half a cell's
    diagonal, for rocks smaller than a cell); it is found if a hazard cell lies within its radius and one cell more.
    """
    seen, found = np.zeros(len(rocks), bool), np.zeros(len(rocks), bool)
    for index, (at_x, at_y, diameter) in enumerate(np.asarray(rocks, np.float64)):
        reach = diameter / 2 + resolution
        columns = slice(*np.searchsorted(x, [at_x - reach, at_x + reach]))
        lines = slice(*np.searchsorted(y, [at_y - reach, at_y + reach]))
        distance = np.hypot(x[None, columns] - at_x, y[lines, None] - at_y)
        own = max(diameter / 2, resolution / np.sqrt(2))
        seen[index] = bool(np.any(visible[lines, columns] & (distance <= own)))
        found[index] = bool(np.any((cells[lines, columns] == Cell.HAZARD) & (distance <= reach)))
    return seen, seen & found


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
        raise ValueError(f"grid origins {origin} and {onto_origin} differ by a fraction of a {resolution} m cell")
    out = np.full(onto, missing, values.dtype)
    low_r, high_r = max(row, 0), min(row + values.shape[0], onto[0])
    low_c, high_c = max(column, 0), min(column + values.shape[1], onto[1])
    if low_r < high_r and low_c < high_c:
        out[low_r:high_r, low_c:high_c] = values[low_r - row : high_r - row, low_c - column : high_c - column]
    return out
