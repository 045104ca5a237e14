"""Binarise: from an elevation map to free, hazard and unknown (paper section 4, "Binary Navigation Map").

The paper compares the elevation itself with 0.2 m, so that a slope of 1.4 degrees, or as much error in the tilt, makes
a hazard of flat ground 8 m away. The default here asks the layers of `TerrainFeatures`, which are measured against the
ground, and calls free only what is known well enough to be no hazard.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import binary_dilation

from flow.contracts import StageError
from stages.data import Array, Cell, CellReason, ElevationMap, NavigationMap, Rover
from stages.stage import Stage, parameter

LAYERS = ("ground", "step", "slope", "steepness", "roughness", "support")  # that TerrainFeatures adds
UNKNOWN = (CellReason.UNOBSERVED, CellReason.OCCLUDED, CellReason.UNSURE)
# Rounding of float32 heights must not push a slope over its limit.
_SLOPE_ROUNDING = 1e-3


@dataclass(frozen=True)
class Binarise(Stage):
    """Classifies each cell as free, hazard or unknown, with the reason.

    method "rover": a hazard is a cell that
    - STEP: reaches `max_step` from the ground, or is part of an obstacle that does;
    - CLEARANCE: stands `ground_clearance` above the ground between the wheels;
    - SLOPE: lies on ground steeper than `max_slope` under the footprint, or under a wheel;
    - ROUGHNESS: has heights about it whose root mean square off their plane exceeds `max_roughness`;
    - BESIDE: is measured, and within `hazard_margin` of a cell that is a hazard for STEP or CLEARANCE: to a cell or
    two nobody
      knows where a rock ends (0.25 px of disparity are 7 cm at 8 m).
    Other cells are unknown where they have no height (OCCLUDED where the map says so, else UNOBSERVED), and UNSURE
    where they have fewer points than `min_points`, where so few cells lie about them that the ground is not determined
    or a step not ruled out, where the layer `variance`, if the map has it, does not say that the height is known to
    `max_sigma`, within `rim` of an obstacle, at a brink, or where a wheel might stand too steeply. The rest is free
    (CLEAR).

    A brink is a cell within half a `wheel` of hidden ground that falls away: that lies, within `max_drop_distance`
    through what is hidden, at least `min_drop` below the ground about it (layer `drop`, if the map has it). Behind a
    bump one sees the ground go on where it was; behind the edge of a cliff or ditch, lower, or not at all.

    The plane under a wheel rests on few cells: near the limit, steepness is off by 2 degrees (RMS, simulated ground).
    So a spot is UNSURE if it would be too steep were the difference of its steepness from the footprint's slope larger
    by `steepness_error` of it; on a plane there is no difference.

    Ground wider than TerrainFeatures.surroundings is terrain, not an obstacle: its edge is a hazard, its top is judged
    as ground.

    method "absolute", the paper's: a hazard is a cell whose elevation exceeds `max_step` (ELEVATION); all others with
    points are free, however little is known of their height.
    """

    method: str = parameter("rover", "hazard rule", choices=("rover", "absolute"))
    rover: Rover = parameter(Rover(), "the vehicle; `absolute` compares elevations with its max_step")
    max_roughness: float = parameter(0.06, "root mean square of heights off their plane", unit="m", low=0.0)
    height_margin: float = parameter(
        0.03, "a height this close to its limit counts as reaching it: cells blunt a peak", unit="m", low=0.0
    )
    hazard_margin: float = parameter(0.05, "cells this near to an obstacle are hazards too", unit="m", low=0.0)
    rim: float = parameter(0.1, "cells this near to one are not free", unit="m", low=0.0)
    max_sigma: float = parameter(
        0.067, "standard deviation of a cell's height beyond which it is not free (3 are a step)", unit="m", low=0.0
    )
    min_support: float = parameter(
        0.3, "share of the cells within a wheel's reach that must be known for a cell to be free", low=0.0, high=1.0
    )
    min_drop: float = parameter(
        0.1, "how far below the ground about it hidden ground lies that may be a drop: a part of its depth is all that "
        "shows of a ditch", unit="m", low=0.0,
    )  # fmt: skip
    max_drop_distance: float = parameter(1.0, "how far from there it may begin to fall", unit="m", low=0.0)
    steepness_error: float = parameter(
        0.25, "share of the difference of steepness and slope that may be missing from it", low=0.0
    )
    min_points: int = parameter(1, "points without which a cell is not free, where the map counts them", low=1)

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
        height = elevation.layers["elevation"]
        observed = np.isfinite(height)
        if self.method == "absolute":
            reason = np.where(observed & (height > self.rover.max_step), CellReason.ELEVATION, CellReason.CLEAR)
        else:
            reason = self._rover(elevation, observed)
        if "count" in elevation.layers:
            reason[(reason == CellReason.CLEAR) & (elevation.layers["count"] < self.min_points)] = CellReason.UNSURE
        hidden = elevation.layers.get("occluded", np.zeros_like(height)) == 1
        reason[~observed] = np.where(hidden, CellReason.OCCLUDED, CellReason.UNOBSERVED)[~observed]
        cells = np.full(reason.shape, Cell.HAZARD, np.int8)
        cells[reason == CellReason.CLEAR] = Cell.FREE
        cells[np.isin(reason, UNKNOWN)] = Cell.UNKNOWN
        return NavigationMap(
            elevation.stamp, cells, reason.astype(np.uint8), elevation.resolution, elevation.origin, elevation.frame_id
        )

    def _rover(self, elevation: ElevationMap, observed: Array) -> Array:
        """Reasons of the observed cells, (rows, cols); what stands in others says nothing."""
        missing = [name for name in LAYERS if name not in elevation.layers]
        if missing:
            raise StageError(
                f"Binarise: the map has no layer '{missing[0]}'; put stages.TerrainFeatures before stages.Binarise"
            )
        ground, step, slope, steepness, roughness, support = (elevation.layers[name] for name in LAYERS)
        above = elevation.layers["elevation"] - ground
        high = observed & (step >= self.rover.max_step - self.height_margin)
        belly = observed & (above >= self.rover.ground_clearance - self.height_margin)
        limit = self.rover.max_slope + _SLOPE_ROUNDING

        known = np.isfinite(slope) & np.isfinite(roughness) & (support >= self.min_support) & self._sure(elevation)
        known &= steepness + self.steepness_error * (steepness - slope) <= limit
        known &= ~self._at_brink(elevation) & ~_near(high | belly, self.rim / elevation.resolution)
        reason = np.where(known, CellReason.CLEAR, CellReason.UNSURE)
        reason[_near(high | belly, self.hazard_margin / elevation.resolution)] = CellReason.BESIDE
        reason[roughness > self.max_roughness] = CellReason.ROUGHNESS
        reason[(slope > limit) | (steepness > limit)] = CellReason.SLOPE
        reason[belly] = CellReason.CLEARANCE
        reason[high] = CellReason.STEP
        return reason

    def _sure(self, elevation: ElevationMap) -> Array:
        """Cells whose height is known well enough to be called free, (rows, cols) bool."""
        if "variance" not in elevation.layers:
            return np.ones(elevation.shape, bool)
        return elevation.layers["variance"] <= self.max_sigma**2

    def _at_brink(self, elevation: ElevationMap) -> Array:
        """Cells next to hidden ground that falls away, (rows, cols) bool."""
        if "drop" not in elevation.layers:
            return np.zeros(elevation.shape, bool)
        hidden = elevation.layers["occluded"] == 1
        falls = hidden & (elevation.layers["drop"] >= self.min_drop)
        reach = int(self.max_drop_distance / elevation.resolution + 1e-6)
        if reach and falls.any():
            falls = binary_dilation(falls, np.ones((3, 3)), iterations=reach, mask=hidden)
        return _near(falls, np.ceil(self.rover.wheel / 2 / elevation.resolution - 1e-6))


def _near(cells: Array, distance: float) -> Array:
    """The cells within `distance` cells of one of `cells`, diagonal neighbours counting as one apart, (rows, cols)."""
    reach = int(distance + 1e-6)
    if not reach:
        return cells
    return cv2.dilate(cells.view(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)).view(bool)
