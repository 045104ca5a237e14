"""Error measures of maps against exact truth: heights, what was known, how well the stated sigma holds, rocks, hazards.

A tally adds up frames in the memory of one. What each figure counts is told where it is summed; the words are:

- *seen*: a cell that a pixel hits which both cameras see, within the region (true layer `visible`), and not farther
  from base_link than `NEAR`;
- *in view*: a cell of which both cameras could see something on a line of sight between the pixels (true layer
  `in_view`); a value in a cell that is not in view is made up, unless it stands in the layer `filled`;
- *levelled*: less the best-fit plane of the frame's errors over the seen cells, which forgives tilt and offset;
- a *rock* is in view if both cameras see at least `SHOWN` of its height and `PIXELS` of its pixels within the region;
  one of which they see anything at all is counted apart. It is found if a hazard cell lies on it or one cell beside it;
- a cell is *on a rock* of 0.2 m if its centre is, low rim and all.

An unknown cell is neither free nor a hazard: it finds no rock and raises no alarm.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from recordings.scoring.metrics import HeightErrors, cell_centres, in_ring, share, without_plane
from stages.data import Array, Cell, ElevationMap

NEAR = 8.0  # m from base_link, within which cells and rocks are asked for
RINGS = ((0.0, 2.0), (2.0, 4.0), (4.0, 6.0), (6.0, 8.0), (0.0, 4.0), (4.0, 8.0), (0.0, 8.0))  # m from base_link
HIGH_ROCK, HIGHER_ROCK = 0.2, 0.3  # m
SHOWN, PIXELS = 0.5, 20
ROCK_COUNTS = ("in_view", "found", "glimpsed", "glimpsed_found")
SLOPES = (0.0, 5.0, 10.0, 15.0, 20.0)  # degrees, borders of the bins of false alarms


@dataclass(frozen=True)
class TrueGround:
    """What is true of a frame's map; arrays (rows, cols), x and y (cols,) and (rows,) cell centres, m.

    mean: height of the surface over the cell, m, NaN where no pixel sees it; seen, in_view: bool; hazard: bool; rock:
    height of the rock that the cell lies on, m, 0 for none; slope: of the bare ground over 1 m, rad; rocks: (N, 6) x,
    y, diameter, height, m, pixels that both cameras see, and the part of the height they span.
    """

    x: Array
    y: Array
    mean: Array
    seen: Array
    in_view: Array
    hazard: Array
    rock: Array
    slope: Array
    rocks: Array

    @classmethod
    def of(cls, terrain: ElevationMap, hazard: Array, rocks: Array) -> TrueGround | None:
        """The truth in a map with the layers of the simulator; None where it lacks them."""
        layers = terrain.layers
        if not {"mean", "visible", "in_view", "rock", "slope"} <= layers.keys() or rocks.shape[1] != 6:
            return None
        x, y = cell_centres(terrain)
        seen = (layers["visible"] > 0.5) & in_ring(np.hypot(x[None, :], y[:, None]), 0.0, NEAR)
        return cls(x, y, layers["mean"].astype(np.float64), seen, layers["in_view"] > 0.5, hazard, layers["rock"],
                   layers["slope"], rocks)  # fmt: skip


class TerrainTally:
    """Sums up the maps of any number of frames."""

    def __init__(self) -> None:
        self.heights = {ring: (HeightErrors(), HeightErrors()) for ring in RINGS}
        self.counts = Counter[str]()

    def add(
        self, truth: TrueGround, layers: dict[str, Array], cells: Array | None, tilts: Array | None = None
    ) -> dict[str, float]:
        """Count one frame, and give its main figures.

        layers: of the elevation map, on the truth's grid, or empty; cells: `Cell` codes or None; tilts: (N, 2) slopes
        along x and y by which other errors of the tilt would lean the map, against its own. A frame has a single tilt,
        and with it all cells are off together: thirty frames say little about whether the intervals with the tilt's
        hold. Where `tilts` are given, those are counted for each instead of for the one.
        """
        unknown = np.full(truth.seen.shape, np.nan)
        elevation = layers.get("elevation", unknown).astype(np.float64)
        self._add_heights(truth, layers, elevation, np.zeros((1, 2)) if tilts is None else tilts)
        cells = np.full(truth.seen.shape, np.int8(Cell.UNKNOWN)) if cells is None else cells
        hazards, rocks = _hazards(truth, cells), _rocks(truth, cells)
        self.counts.update(hazards)
        self.counts.update(rocks)
        error = (elevation - truth.mean)[truth.seen & np.isfinite(elevation)]
        return {
            "elevation_completeness": share(error.size, hazards["seen"]),
            "elevation_rmse": share(np.square(error).sum(), error.size) ** 0.5,
            "elevation_bias": share(error.sum(), error.size),
            "false_alarm": share(hazards["safe_told"], hazards["safe"]),
            "false_safe": share(hazards["hazards_free"], hazards["hazards"]),
            **{f"rocks_{name}": float(rocks[f"{name}_{HIGH_ROCK:g}"]) for name in ("in_view", "found")},
        }

    def _add_heights(self, truth: TrueGround, layers: dict[str, Array], elevation: Array, tilts: Array) -> None:
        known = np.isfinite(elevation)
        error = np.where(truth.seen, elevation - truth.mean, np.nan)
        levelled = without_plane(truth.x, truth.y, error)
        radius = np.hypot(truth.x[None, :], truth.y[:, None])
        for limits, parts in self.heights.items():
            ring = truth.seen & in_ring(radius, *limits)
            for errors, values in zip(parts, (error, levelled), strict=True):
                errors.add(values[ring])
        within = in_ring(radius, 0.0, NEAR)
        counts = {
            "values": known & within,
            "made_up": known & within & ~truth.in_view,
            "between_pixels": known & within & truth.in_view & ~truth.seen,
            "cells": within,
        }
        self.counts.update(_summed(counts))
        if "variance" in layers:
            variance = layers["variance"].astype(np.float64)
            common = layers.get("common_variance", np.zeros_like(variance))
            self.counts.update(_intervals("random", levelled, variance))
            for east, north in tilts:
                lean = east * truth.x[None, :] + north * truth.y[:, None]
                self.counts.update(_intervals("total", error + lean, variance + common))

    def measures(self) -> dict[str, Any]:
        """All figures; shares 0 to 1, lengths m, NaN where there was nothing to measure.

        heights: ring -> seen, completeness, raw and levelled `HeightErrors.measures`; made_up: values in cells not in
        view, as a share of all values and of all cells within 8 m, and between_pixels, in view but not seen, of all
        values; intervals: share of levelled errors within one and two stated random sigmas (random), and of raw errors
        within those of random and common variance together (total); rocks: "0.2 m", "0.3 m" -> in_view, found, recall,
        and glimpsed, glimpsed_found; hazards: see `_hazards`.
        """
        c = self.counts
        heights = {
            f"{low:g}-{high:g} m": {
                "seen": raw.seen,
                "completeness": share(raw.cells, raw.seen),
                "raw": raw.measures(),
                "levelled": levelled.measures(),
            }
            for (low, high), (raw, levelled) in self.heights.items()
        }
        rocks = {
            f"{limit:g} m": {
                **{name: float(c[f"{name}_{limit:g}"]) for name in ROCK_COUNTS},
                "recall": share(c[f"found_{limit:g}"], c[f"in_view_{limit:g}"]),
            }
            for limit in (HIGH_ROCK, HIGHER_ROCK)
        }

        def part(of: str, whole: str) -> float:
            return share(c[of], c[whole])

        return {
            "heights": heights,
            "made_up": {"of_values": part("made_up", "values"), "of_cells": part("made_up", "cells"),
                        "between_pixels": part("between_pixels", "values")},
            "intervals": {name: {str(k): part(f"{name}_in_{k}", f"{name}_judged") for k in (1, 2)}
                          for name in ("random", "total")},
            "rocks": rocks,
            "hazards": {
                "recall": part("hazards_told", "hazards"),
                "false_safe": part("hazards_free", "hazards"),
                "rock_recall": part("rock_cells_told", "rock_cells"),
                "rock_false_safe": part("rock_cells_free", "rock_cells"),
                "free_on_rock": part("free_on_rock", "free"),
                "false_alarm": part("safe_told", "safe"),
                "unknown": part("unknown", "seen"),
                "free_hazard": part("free_hazard", "free"),
                "free_unseen": part("free_unseen", "free"),
                "by_slope": {f"{low:g}-{high:g} deg": part(f"safe_told_{low:g}", f"safe_{low:g}")
                             for low, high in pairwise(SLOPES)},
            },
        }  # fmt: skip


def _intervals(name: str, error: Array, variance: Array) -> dict[str, int]:
    """How many errors of one frame are known, and within one and two standard deviations."""
    judged = np.isfinite(error) & np.isfinite(variance)
    sigmas = np.abs(error[judged]) / np.sqrt(np.maximum(variance[judged], 1e-18))
    return _summed({f"{name}_judged": judged, f"{name}_in_1": sigmas <= 1, f"{name}_in_2": sigmas <= 2})


def _hazards(truth: TrueGround, cells: Array) -> dict[str, int]:
    """Sums over one frame, of seen cells: hazards, told, called free; the same of those on a rock; safe ones, told to
    be hazards, also by slope; unknown ones. And of all cells called free, wherever they are, those on a rock, those
    that are hazards, and those that are not in view."""
    free, told, seen = cells == Cell.FREE, cells == Cell.HAZARD, truth.seen
    on_rock = truth.rock >= np.float32(HIGH_ROCK)
    safe = seen & ~truth.hazard
    masks = {
        "seen": seen,
        "unknown": seen & ~free & ~told,
        "hazards": seen & truth.hazard,
        "hazards_told": seen & truth.hazard & told,
        "hazards_free": seen & truth.hazard & free,
        "rock_cells": seen & on_rock,
        "rock_cells_told": seen & on_rock & told,
        "rock_cells_free": seen & on_rock & free,
        "safe": safe,
        "safe_told": safe & told,
        "free": free,
        "free_on_rock": free & on_rock,
        "free_hazard": free & truth.hazard,
        "free_unseen": free & ~truth.in_view,
    }
    for low, high in pairwise(SLOPES):
        inside = safe & (truth.slope >= np.radians(low)) & (truth.slope < np.radians(high))
        masks |= {f"safe_{low:g}": inside, f"safe_told_{low:g}": inside & told}
    return _summed(masks)


def _rocks(truth: TrueGround, cells: Array) -> Counter[str]:
    """Sums over one frame: rocks in view and found, and those of which anything is seen, by least height."""
    counts = Counter[str]()
    step = float(truth.x[1] - truth.x[0])
    for at_x, at_y, diameter, height, pixels, shown in np.asarray(truth.rocks, np.float64):
        if height < np.float32(HIGH_ROCK) or pixels < 1 or np.hypot(at_x, at_y) >= NEAR:
            continue
        reach = diameter / 2 + step
        columns = slice(*np.searchsorted(truth.x, [at_x - reach, at_x + reach]))
        lines = slice(*np.searchsorted(truth.y, [at_y - reach, at_y + reach]))
        close = np.hypot(truth.x[None, columns] - at_x, truth.y[lines, None] - at_y) <= reach
        found = bool(np.any((cells[lines, columns] == Cell.HAZARD) & close))
        in_view = bool(shown >= SHOWN and pixels >= PIXELS)
        for limit in (HIGH_ROCK, HIGHER_ROCK):
            if height >= np.float32(limit):
                counts.update({
                    f"glimpsed_{limit:g}": 1, f"glimpsed_found_{limit:g}": found,
                    f"in_view_{limit:g}": in_view, f"found_{limit:g}": in_view and found,
                })  # fmt: skip
    return counts


def _summed(masks: dict[str, Array]) -> dict[str, int]:
    return {name: int(np.count_nonzero(mask)) for name, mask in masks.items()}
