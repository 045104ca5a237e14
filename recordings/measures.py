"""Error measures over arrays: elevation, hazards, rocks, tilt. Pure functions, no files.

What is summed over frames comes in two steps: `..._counts` of one frame, which add up, and `..._measures` of the sum,
so that a log of any length takes the memory of one frame and every pixel or cell, not every frame, counts the same.
NaN is "unknown" and never takes part in an error; shares of an empty set are NaN, because there is nothing to say.
"""

from __future__ import annotations

from typing import Any, SupportsFloat

import numpy as np
from numpy.typing import ArrayLike

from stages.data import Array, Cell

CLOSE = 0.05  # m, the height error that the Lunar Autonomy Challenge accepts
NMAD_SCALE = 1.4826  # makes the median deviation of a normal distribution its standard deviation
NMAD_BIN = 1e-5  # m, to which errors are rounded for their median
NMAD_REACH = 1.0  # m, beyond which errors are one bin
ROCK_OUTLINE = 1.25  # a rock reaches this many mean radii from its centre: rocks are longer than they are wide


def share(part: SupportsFloat, whole: SupportsFloat) -> float:
    """part / whole, NaN where there is no whole."""
    return float(part) / float(whole) if float(whole) else float("nan")


def added(first: dict[str, float], second: dict[str, float]) -> dict[str, float]:
    """The counts of two sets of frames as those of one; an empty dict counts nothing."""
    return {name: first.get(name, 0.0) + second.get(name, 0.0) for name in first | second}


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


class RingErrors:
    """Height errors by distance, raw and levelled (less the best plane of each map), of any number of maps."""

    def __init__(self, rings: tuple[tuple[float, float], ...]) -> None:
        self.rings = {ring: (HeightErrors(), HeightErrors()) for ring in rings}

    def add(self, x: Array, y: Array, counted: Array, error: Array) -> None:
        """Count one map. x: (cols,), y: (rows,) cell centres, m; counted, error: (rows, cols), error m, NaN = unknown.

        The plane is that of the errors at the counted cells.
        """
        radius, error = np.hypot(x[None, :], y[:, None]), np.where(counted, error, np.nan)
        levelled = without_plane(x, y, error)
        for limits, parts in self.rings.items():
            cells = counted & in_ring(radius, *limits)
            for errors, values in zip(parts, (error, levelled), strict=True):
                errors.add(values[cells])

    def measures(self) -> dict[str, Any]:
        """Ring ("0-4 m") -> seen (cells counted), completeness (share of them known), raw and levelled measures."""
        return {
            f"{low:g}-{high:g} m": {
                "seen": raw.seen,
                "completeness": share(raw.cells, raw.seen),
                "raw": raw.measures(),
                "levelled": levelled.measures(),
            }
            for (low, high), (raw, levelled) in self.rings.items()
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


def hazard_counts(cells: Array, truth: Array, seen: Array, counted: Array, rock: Array | None) -> dict[str, float]:
    """Sums for `hazard_measures` over one frame; all (rows, cols).

    cells, truth: `Cell` codes, any code but free and hazard being unknown; seen: bool, cells that both cameras see;
    counted: bool, those of them that are near enough to ask for; rock: bool, cells on a high rock (None: not told).
    """
    free, told = cells == Cell.FREE, cells == Cell.HAZARD
    hazard, safe = truth == Cell.HAZARD, truth == Cell.FREE
    masks = {
        "cells": counted,
        "unknown": counted & ~free & ~told,
        "hazards": counted & hazard,
        "hazards_told": counted & hazard & told,
        "hazards_free": counted & hazard & free,
        "safe": counted & safe,
        "safe_told": counted & safe & told,
        "free": free,
        "free_hazard": free & hazard,
        "free_unseen": free & ~seen,
        "free_unseen_hazard": free & ~seen & hazard,
        "free_asked": free if rock is not None else np.zeros(1),
        "free_on_rock": free & rock if rock is not None else np.zeros(1),
    }
    return {name: float(np.count_nonzero(mask)) for name, mask in masks.items()}


def hazard_measures(counts: dict[str, float]) -> dict[str, Any]:
    """How well a map finds the hazards and how far it can be trusted, of added `hazard_counts`.

    Over the counted cells: cells (how many), unknown (share), recall (of true hazards, called hazard), false_safe (of
    true hazards, called free), false_alarm (of truly free cells, called hazard). Over all cells that the map calls
    free, wherever they lie: free (how many), free_hazard (share that are true hazards), free_on_rock (share on a high
    rock), free_unseen (those that the cameras did not both see: cells, share of all free ones, hazards among them).
    """
    return {
        "cells": counts["cells"],
        "unknown": share(counts["unknown"], counts["cells"]),
        "recall": share(counts["hazards_told"], counts["hazards"]),
        "false_safe": share(counts["hazards_free"], counts["hazards"]),
        "false_alarm": share(counts["safe_told"], counts["safe"]),
        "free": counts["free"],
        "free_hazard": share(counts["free_hazard"], counts["free"]),
        "free_on_rock": share(counts["free_on_rock"], counts["free_asked"]),
        "free_unseen": {
            "cells": counts["free_unseen"], "share": share(counts["free_unseen"], counts["free"]),
            "hazards": counts["free_unseen_hazard"],
        },
    }  # fmt: skip


def on_rocks(rocks: Array, hazard: Array, x: Array, y: Array) -> Array:
    """Mask (rows, cols) of the cells on a rock: true hazard cells whose centre is within a rock's outline.

    rocks: (N, 3) x, y, mean diameter, m; hazard: (rows, cols) bool; x, y: (cols,) and (rows,) cell centres, m. The
    outline is a circle about the longest rocks (`ROCK_OUTLINE`); of it, the true hazards are the rock itself.
    """
    mask = np.zeros(hazard.shape, bool)
    for at_x, at_y, diameter in np.asarray(rocks, np.float64):
        reach = ROCK_OUTLINE * diameter / 2
        columns = slice(*np.searchsorted(x, [at_x - reach, at_x + reach]))
        lines = slice(*np.searchsorted(y, [at_y - reach, at_y + reach]))
        mask[lines, columns] |= np.hypot(x[None, columns] - at_x, y[lines, None] - at_y) <= reach
    return mask & hazard


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
