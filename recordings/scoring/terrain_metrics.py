"""Error metrics of maps against exact truth: heights, coverage, stated sigma, rocks, hazards.

A tally sums up frames in the memory of one. The terms:

- *visible*: a cell within `MAX_DISTANCE` of base_link that a pixel of both cameras hits (true layer `visible`);
- *in view*: a cell with a line of sight from both cameras, through a pixel or between pixels (true layer `in_view`);
- *hallucinated*: a value in a cell that is not in view;
- *unseen*: a value in a cell that is not visible; *claimed* if the layer `interpolated` does not mark it;
- *levelled*: minus the best-fit plane of the frame's errors over the visible cells, which removes tilt and offset;
- a *visible rock*: both cameras see at least `MIN_ROCK_SHARE` of its height and `MIN_ROCK_PIXELS` of its pixels; one of
  which they see any pixel is *partly visible*. It is detected if a hazard cell is on it or one cell beside it;
- a cell is *on a rock* if its centre is, including its low rim.

An unknown cell is neither free nor a hazard: it detects no rock and raises no false alarm.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from recordings.scoring.metrics import HeightErrors, in_ring, share, without_plane
from stages.data import Array, Cell, ElevationMap, cell_centres

MAX_DISTANCE = 8.0  # m from base_link, of cells and rocks
RINGS = ((0.0, 2.0), (2.0, 4.0), (4.0, 6.0), (6.0, 8.0), (0.0, 4.0), (4.0, 8.0), (0.0, 8.0))  # m from base_link
HIGH_ROCK, HIGHER_ROCK = 0.2, 0.3  # m
MIN_ROCK_SHARE, MIN_ROCK_PIXELS = 0.5, 20
ROCK_COUNTS = ("visible", "detected", "partly_visible", "partly_visible_detected")
SLOPES = (0.0, 5.0, 10.0, 15.0, 20.0)  # degrees, bins of the false alarms


@dataclass(frozen=True)
class TrueGround:
    """The truth of a frame's map: arrays (rows, cols), and x (cols,) and y (rows,) of the cell centres, m.

    mean: height of the visible surface, m, NaN where none is visible; seen, in_view, hazard: bool; rock: height of the
    rock at the cell's centre, m, 0 for none; slope: of the bare ground over 1 m, rad; rocks: (N, 6) x, y, diameter,
    height, m, pixels that both cameras see, and the share of the height that these span.
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
    def of(cls, terrain: ElevationMap, hazard: Array, rocks: Array) -> TrueGround:
        """The truth from a map with the layers of the simulator. Raises ValueError if any is missing."""
        layers = terrain.layers
        if not {"mean", "visible", "in_view", "rock", "slope"} <= layers.keys() or rocks.shape[1] != 6:
            raise ValueError("the truth lacks layers or fields that the simulator writes")
        x, y = cell_centres(terrain)
        seen = (layers["visible"] > 0.5) & in_ring(np.hypot(x[None, :], y[:, None]), 0.0, MAX_DISTANCE)
        return cls(x, y, layers["mean"].astype(np.float64), seen, layers["in_view"] > 0.5, hazard, layers["rock"],
                   layers["slope"], rocks)  # fmt: skip


class TerrainTally:
    """Sums up the maps of frames."""

    def __init__(self) -> None:
        self.heights = {ring: (HeightErrors(), HeightErrors()) for ring in RINGS}
        self.counts = Counter[str]()

    def add(self, truth: TrueGround, layers: dict[str, Array], cells: Array | None) -> dict[str, float]:
        """Add one frame; returns its main metrics.

        layers: of the elevation map, on the truth's grid, or empty; cells: `Cell` codes or None.
        """
        unknown = np.full(truth.seen.shape, np.nan)
        elevation = layers.get("elevation", unknown).astype(np.float64)
        self._add_heights(truth, layers, elevation)
        cells = np.full(truth.seen.shape, np.int8(Cell.UNKNOWN)) if cells is None else cells
        hazards, rocks = _hazards(truth, cells), _rocks(truth, cells)
        self.counts.update(hazards)
        self.counts.update(rocks)
        error = (elevation - truth.mean)[truth.seen & np.isfinite(elevation)]
        return {
            "elevation_completeness": share(error.size, hazards["seen"]),
            "elevation_rmse": share(np.square(error).sum(), error.size) ** 0.5,
            "elevation_bias": share(error.sum(), error.size),
            "false_alarm": share(hazards["false_alarms"], hazards["safe"]),
            "false_safe": share(hazards["hazards_free"], hazards["hazards"]),
            **{f"rocks_{name}": float(rocks[f"{name}_{HIGH_ROCK:g}"]) for name in ("visible", "detected")},
        }

    def _add_heights(self, truth: TrueGround, layers: dict[str, Array], elevation: Array) -> None:
        known = np.isfinite(elevation)
        error = np.where(truth.seen, elevation - truth.mean, np.nan)
        levelled = without_plane(truth.x, truth.y, error)
        radius = np.hypot(truth.x[None, :], truth.y[:, None])
        for limits, parts in self.heights.items():
            ring = truth.seen & in_ring(radius, *limits)
            for errors, values in zip(parts, (error, levelled), strict=True):
                errors.add(values[ring])
        within, marked = in_ring(radius, 0.0, MAX_DISTANCE), layers.get("interpolated", np.zeros_like(elevation)) == 1
        counts = {
            "values": known & within,
            "hallucinated": known & within & ~truth.in_view,
            "unseen": known & within & ~truth.seen,
            "claimed": known & within & ~truth.seen & ~marked,
        }
        self.counts.update(_summed(counts))
        if "variance" in layers:
            variance = layers["variance"].astype(np.float64)
            common = layers.get("common_variance", np.zeros_like(variance))
            self.counts.update(_intervals("random", levelled, variance))
            self.add_total(truth, error, variance + common)

    def add_total(self, truth: TrueGround, error: Array, variance: Array) -> None:
        """Add the errors of heights, m, of one frame, and their variances, those of the tilt included."""
        self.counts.update(_intervals("total", error, variance))

    def metrics(self) -> dict[str, Any]:
        """All metrics; shares 0 to 1, lengths m, NaN if nothing was measured.

        heights: ring -> seen (visible cells), completeness, and `HeightErrors.metrics` raw and levelled; hallucinated,
        unseen, claimed: as share of all values; intervals: share of levelled errors within 1 and 2 stated random sigmas
        (random), and of raw errors within sigmas of random and common variance (total); rocks: "0.2 m", "0.3 m" ->
        visible, detected, recall, partly_visible, partly_visible_detected; hazards: see `_hazards`.
        """
        c = self.counts
        heights = {
            f"{low:g}-{high:g} m": {
                "seen": raw.seen,
                "completeness": share(raw.cells, raw.seen),
                "raw": raw.metrics(),
                "levelled": levelled.metrics(),
            }
            for (low, high), (raw, levelled) in self.heights.items()
        }
        rocks = {
            f"{limit:g} m": {
                **{name: float(c[f"{name}_{limit:g}"]) for name in ROCK_COUNTS},
                "recall": share(c[f"detected_{limit:g}"], c[f"visible_{limit:g}"]),
            }
            for limit in (HIGH_ROCK, HIGHER_ROCK)
        }

        def part(of: str, whole: str) -> float:
            return share(c[of], c[whole])

        return {
            "heights": heights,
            "hallucinated": {"of_values": part("hallucinated", "values"), "unseen": part("unseen", "values"),
                             "claimed": part("claimed", "values")},
            "intervals": {name: {str(k): part(f"{name}_in_{k}", f"{name}_judged") for k in (1, 2)}
                          for name in ("random", "total")},
            "rocks": rocks,
            "hazards": {
                "recall": part("hazards_detected", "hazards"),
                "false_safe": part("hazards_free", "hazards"),
                "rock_false_safe": part("rock_cells_free", "rock_cells"),
                "free_on_rock": part("free_on_rock", "free"),
                "false_alarm": part("false_alarms", "safe"),
                "unknown": part("unknown", "seen"),
                "free_unseen": part("free_unseen", "free"),
                "by_slope": {f"{low:g}-{high:g} deg": part(f"false_alarms_{low:g}", f"safe_{low:g}")
                             for low, high in pairwise(SLOPES)},
            },
        }  # fmt: skip


def _intervals(name: str, error: Array, variance: Array) -> dict[str, int]:
    """The number of known errors of one frame, and of those within one and two standard deviations."""
    judged = np.isfinite(error) & np.isfinite(variance)
    sigmas = np.abs(error[judged]) / np.sqrt(np.maximum(variance[judged], 1e-18))
    return _summed({f"{name}_judged": judged, f"{name}_in_1": sigmas <= 1, f"{name}_in_2": sigmas <= 2})


def _hazards(truth: TrueGround, cells: Array) -> dict[str, int]:
    """Sums over the cells of one frame.

    Of visible cells: hazards, those detected, those called free; cells on a rock, those called free; safe cells, those
    called hazards, also by slope; unknown cells. Of all cells within 8 m called free: those on a rock, and those out of
    view.
    """
    within = in_ring(np.hypot(truth.x[None, :], truth.y[:, None]), 0.0, MAX_DISTANCE)
    free, flagged, seen = (cells == Cell.FREE) & within, cells == Cell.HAZARD, truth.seen
    on_rock = truth.rock >= np.float32(HIGH_ROCK)
    safe = seen & ~truth.hazard
    masks = {
        "seen": seen,
        "unknown": seen & ~free & ~flagged,
        "hazards": seen & truth.hazard,
        "hazards_detected": seen & truth.hazard & flagged,
        "hazards_free": seen & truth.hazard & free,
        "rock_cells": seen & on_rock,
        "rock_cells_free": seen & on_rock & free,
        "safe": safe,
        "false_alarms": safe & flagged,
        "free": free,
        "free_on_rock": free & on_rock,
        "free_unseen": free & ~truth.in_view,
    }
    for low, high in pairwise(SLOPES):
        inside = safe & (truth.slope >= np.radians(low)) & (truth.slope < np.radians(high))
        masks |= {f"safe_{low:g}": inside, f"false_alarms_{low:g}": inside & flagged}
    return _summed(masks)


def _rocks(truth: TrueGround, cells: Array) -> Counter[str]:
    """Sums over the rocks of one frame, by minimum height: visible, partly visible, detected."""
    counts = Counter[str]()
    step = float(truth.x[1] - truth.x[0])
    for at_x, at_y, diameter, height, pixels, shown in np.asarray(truth.rocks, np.float64):
        if height < np.float32(HIGH_ROCK) or pixels < 1 or np.hypot(at_x, at_y) >= MAX_DISTANCE:
            continue
        reach = diameter / 2 + step
        columns = slice(*np.searchsorted(truth.x, [at_x - reach, at_x + reach]))
        lines = slice(*np.searchsorted(truth.y, [at_y - reach, at_y + reach]))
        close = np.hypot(truth.x[None, columns] - at_x, truth.y[lines, None] - at_y) <= reach
        detected = bool(np.any((cells[lines, columns] == Cell.HAZARD) & close))
        visible = bool(shown >= MIN_ROCK_SHARE and pixels >= MIN_ROCK_PIXELS)
        for limit in (HIGH_ROCK, HIGHER_ROCK):
            if height >= np.float32(limit):
                counts.update({
                    f"partly_visible_{limit:g}": 1, f"partly_visible_detected_{limit:g}": detected,
                    f"visible_{limit:g}": visible, f"detected_{limit:g}": visible and detected,
                })  # fmt: skip
    return counts


def _summed(masks: dict[str, Array]) -> dict[str, int]:
    return {name: int(np.count_nonzero(mask)) for name, mask in masks.items()}
