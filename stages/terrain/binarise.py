"""Binarise: from an elevation map to free, hazard and unknown (paper section 4, "Binary Navigation Map").

The paper compares the elevation itself with 0.2 m. A slope of 1.4 degrees, or that error of the tilt, then makes flat
ground at 8 m a hazard. Method "rover" uses the layers of `TerrainFeatures`, which are measured against the ground, and
calls a cell free only if it is known well enough.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from flow.contracts import StageError
from stages.data import Array, Cell, CellReason, ElevationMap, NavigationMap, Rover
from stages.data.arrays import Span, spanned
from stages.stage import Stage, check_types, parameter

LAYERS = ("ground", "step", "slope", "steepness", "roughness", "support")  # of TerrainFeatures
STATE_OF = np.full(len(CellReason), Cell.HAZARD, np.int8)  # by reason
STATE_OF[CellReason.CLEAR] = Cell.FREE
STATE_OF[[CellReason.UNOBSERVED, CellReason.OCCLUDED, CellReason.UNMATCHED, CellReason.UNSURE]] = Cell.UNKNOWN
RIM = 0.1  # m; cells this near to an obstacle are not free
MIN_SUPPORT = 0.3  # share of the cells within a wheel's reach that are known, for a free cell
MAX_DROP_DISTANCE = 1.0  # m through hidden cells, from where hidden ground is low to where it may begin to fall
MIN_HOLE_SHARE = 1 / 3  # of min_drop; how low hidden ground is at least where matching may have narrowed a hole
_SLOPE_ROUNDING = 1e-3  # rad, so that the rounding of float32 heights does not exceed a limit


@dataclass(frozen=True)
class Binarise(Stage):
    """Classifies each cell as free, hazard or unknown, with the reason.

    Method "rover" applies the hazard rule of docs/terrain.md. Method "absolute" is the paper's: a cell whose elevation
    exceeds the rover's max_step is a hazard, other cells with at least `min_points` points are free.

    Examples
    --------
    >>> heights = np.float32([[0.0, 0.1, 0.3, np.nan]])
    >>> result = Binarise(method="absolute")(ElevationMap(0, {"elevation": heights}, 0.05, (0.0, 0.0), "level"))
    >>> result.cells.tolist(), [CellReason(code).name for code in result.reason[0]]
    ([[0, 0, 100, -1]], ['CLEAR', 'CLEAR', 'ELEVATION', 'UNOBSERVED'])
    """

    method: str = parameter("rover", "hazard rule", choices=("rover", "absolute"))
    rover: Rover = parameter(Rover(), "the vehicle; `absolute` compares elevations with its max_step")
    max_roughness: float = parameter(0.06, "largest RMS of heights off their plane on free ground", unit="m", low=0.0)
    height_margin: float = parameter(
        0.03, "a height this close to its limit counts as reaching it, because cells flatten peaks", unit="m", low=0.0
    )
    hazard_margin: float = parameter(0.05, "cells this near to an obstacle are hazards too", unit="m", low=0.0)
    max_sigma: float = parameter(
        0.067, "largest standard deviation of the height of a free cell (a third of a step)", unit="m", low=0.0,
        high=100.0,
    )  # fmt: skip
    min_drop: float = parameter(
        0.1, "depth below its surroundings from which hidden ground may be a drop; only part of a ditch's depth is "
        "measurable", unit="m", low=0.0,
    )  # fmt: skip
    min_rise: float = parameter(
        0.05, "height above the ground, at the edge of view, from which an obstacle may continue out of view; for a "
        "step, twice as much", unit="m", low=0.0,
    )  # fmt: skip
    steepness_error: float = parameter(0.25, "relative error of the difference between steepness and slope", low=0.0)
    min_points: int = parameter(1, "smallest number of points of a free cell, if the map counts points", low=1)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("max_step", "ground_clearance"):
            limit = getattr(self.rover, name)
            if self.method == "rover" and not limit > self.height_margin:
                raise ValueError(
                    f"Binarise.rover.{name} must be above Binarise.height_margin, {self.height_margin:g} m, not "
                    f"{limit:g} m: level ground would reach it"
                )

    def __call__(self, elevation: ElevationMap) -> NavigationMap:
        """The navigation map on the grid of `elevation`."""
        check_types(self, elevation=elevation)
        window = _shown(elevation)
        reason = np.full(elevation.shape, CellReason.UNOBSERVED, np.uint8)
        within = {name: layer[window] for name, layer in elevation.layers.items()}
        if reason.size:  # OpenCV refuses empty masks
            reason[window] = self._reasons(replace(elevation, layers=within))
        cells = np.full(elevation.shape, Cell.UNKNOWN, np.int8)
        cells[window] = STATE_OF[reason[window]]
        return NavigationMap(elevation.stamp, cells, reason, elevation.resolution, elevation.origin, elevation.frame_id)

    def _reasons(self, elevation: ElevationMap) -> Array:
        """Reasons (rows, cols) of all cells."""
        height = elevation.layers["elevation"]
        observed = np.isfinite(height)
        if self.method == "absolute":
            reason = self._clear_or_unsure(elevation)
            reason[observed & (height > self.rover.max_step)] = CellReason.ELEVATION
        else:
            reason = self._rover_reasons(elevation, observed)
        hidden = elevation.layers.get("occluded", np.zeros_like(height)) == 1
        seen = np.isfinite(elevation.layers.get("unmatched", np.full_like(height, np.nan)))
        reason[~observed] = np.where(hidden, CellReason.OCCLUDED, CellReason.UNOBSERVED)[~observed]
        reason[~observed & seen] = CellReason.UNMATCHED
        return np.asarray(reason)

    def _rover_reasons(self, elevation: ElevationMap, observed: Array) -> Array:
        """Reasons (rows, cols), valid in observed cells."""
        missing = [name for name in LAYERS if name not in elevation.layers]
        if missing:
            raise StageError(
                f"Binarise: the map has no layer '{missing[0]}'; put stages.TerrainFeatures before stages.Binarise"
            )
        slope, steepness, roughness = (elevation.layers[name] for name in ("slope", "steepness", "roughness"))
        high, belly = self._obstacles(elevation, observed)
        limit = self.rover.max_slope + _SLOPE_ROUNDING
        reason = self._clear_or_unsure(elevation)
        reason[_dilated(high | belly, self.hazard_margin / elevation.resolution)] = CellReason.BESIDE
        reason[roughness > self.max_roughness] = CellReason.ROUGHNESS
        reason[(slope > limit) | (steepness > limit)] = CellReason.SLOPE
        reason[belly] = CellReason.CLEARANCE
        reason[high] = CellReason.STEP
        return reason

    def _obstacles(self, elevation: ElevationMap, observed: Array) -> tuple[Array, Array]:
        """Cells (rows, cols) bool too high for a wheel, and for the rover's belly."""
        above = elevation.layers["elevation"] - elevation.layers["ground"]
        high = observed & (elevation.layers["step"] >= self.rover.max_step - self.height_margin)
        return high, observed & (above >= self.rover.ground_clearance - self.height_margin)

    def _clear_or_unsure(self, elevation: ElevationMap) -> Array:
        """The reason of each cell without a hazard, (rows, cols): UNSURE where there is a doubt, else CLEAR."""
        unsure = np.any([np.zeros(elevation.shape, bool), *self.doubts(elevation).values()], axis=0)
        return np.where(unsure, CellReason.UNSURE, CellReason.CLEAR)

    def doubts(self, elevation: ElevationMap) -> dict[str, Array]:
        """Doubt, in words -> cells (rows, cols) bool that are not free because of it."""
        found = {} if self.method == "absolute" else self._rover_doubts(elevation)
        if "count" in elevation.layers:
            found["fewer points than min_points"] = elevation.layers["count"] < self.min_points
        return found

    def _rover_doubts(self, elevation: ElevationMap) -> dict[str, Array]:
        ground, step, slope, steepness, roughness, support = (elevation.layers[name] for name in LAYERS)
        observed, above = np.isfinite(elevation.layers["elevation"]), elevation.layers["elevation"] - ground
        obstacle = np.logical_or(*self._obstacles(elevation, observed))
        limit = self.rover.max_slope + _SLOPE_ROUNDING
        found = {
            "no slope or roughness": ~(np.isfinite(slope) & np.isfinite(roughness)),
            f"support below {MIN_SUPPORT:g}": ~(support >= MIN_SUPPORT),
            "possibly too steep (steepness_error)": ~(steepness + self.steepness_error * (steepness - slope) <= limit),
            "on an obstacle that the edge of view cuts (min_rise)": self._cut(elevation, observed, above, step),
            "at a brink (min_drop)": self._brink(elevation),
            "uneven at a hole of hidden ground (min_drop, min_rise)": self._at_hole(elevation, step),
            f"within {RIM:g} m of an obstacle": _dilated(obstacle, RIM / elevation.resolution),
        }
        if "variance" in elevation.layers:
            found["sigma above max_sigma"] = ~(elevation.layers["variance"] <= self.max_sigma**2)
        return found

    def _cut(self, elevation: ElevationMap, observed: Array, above: Array, step: Array) -> Array:
        """Cells (rows, cols) bool of obstacles that the edge of view may cut, and those within half a wheel of the cut.

        above: height above the ground, m. A step counts from twice `min_rise`, because slopes and noise add to it.
        """
        if "occluded" not in elevation.layers:
            return np.zeros(elevation.shape, bool)
        out_of_view = ~observed & ~(elevation.layers["occluded"] == 1)
        raised = observed & ((above >= self.min_rise) | (step >= 2 * self.min_rise))
        cut = raised & _dilated(out_of_view, 1)
        if not cut.any():
            return cut
        near = _dilated(cut, np.ceil(self.rover.wheel / 2 / elevation.resolution - 1e-6))
        count, obstacle = cv2.connectedComponents(raised.view(np.uint8), connectivity=8)
        is_cut = np.zeros(count, bool)
        is_cut[obstacle[cut]] = True
        return np.asarray(near | is_cut[obstacle])

    def _brink(self, elevation: ElevationMap) -> Array:
        """Cells within half a wheel of hidden ground that falls away, (rows, cols) bool."""
        if not {"drop", "occluded"} <= elevation.layers.keys():
            return np.zeros(elevation.shape, bool)
        hidden = elevation.layers["occluded"] == 1
        falls = hidden & (elevation.layers["drop"] >= self.min_drop)
        reach = int(MAX_DROP_DISTANCE / elevation.resolution + 1e-6)
        for _ in range(reach if falls.any() else 0):
            falls = hidden & _dilated(falls, 1)
        return _dilated(falls, np.ceil(self.rover.wheel / 2 / elevation.resolution - 1e-6))

    def _at_hole(self, elevation: ElevationMap, step: Array) -> Array:
        """Uneven cells, (rows, cols) bool, beside low hidden ground, where this ground takes the room of a wheel.

        Matching smears the near edge and the far wall of a ditch. Their heights fill most of it, and lift its ceiling.
        """
        if not {"drop", "occluded"} <= elevation.layers.keys():
            return np.zeros(elevation.shape, bool)
        wheel = self.rover.wheel / elevation.resolution
        low = (elevation.layers["occluded"] == 1) & (elevation.layers["drop"] >= MIN_HOLE_SHARE * self.min_drop)
        uneven = (step >= self.min_rise) & _dilated(low, np.ceil(wheel / 2 - 1e-6) + 1)
        count, hole = cv2.connectedComponents((low | uneven).view(np.uint8), connectivity=8)
        area = np.bincount(hole.ravel(), low.ravel(), count)
        return np.asarray(uneven & (area[hole] >= wheel**2 - 1e-6))


def _shown(elevation: ElevationMap) -> Span:
    """The rows and columns of the cells that anything is known of, and of their neighbours."""
    shown = np.isfinite(elevation.layers["elevation"])
    for name in ("occluded", "unmatched"):
        if name in elevation.layers:
            shown |= np.isfinite(elevation.layers[name])
    return spanned(shown, 1)


def _dilated(cells: Array, distance: float) -> Array:
    """The cells within `distance` cells of the mask `cells`; a diagonal neighbour is one cell away."""
    reach = int(min(distance, max(cells.shape)) + 1e-6)
    if not reach:
        return cells
    return cv2.dilate(cells.view(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)).view(bool)
