"""Binarise: from an elevation map to free, hazard and unknown (paper section 4, "Binary Navigation Map").

The paper compares the elevation itself with 0.2 m, so that a slope of 1.4 degrees, or as much error in the tilt, makes
a hazard of flat ground 8 m away. The default here measures against the ground: planes fitted about every cell, first
wide and then the rover's size, each time to the cells that the plane before called ground, so that a rock stands out of
the ground instead of bending it. The heights that remain do not change when the whole scene is tilted or raised.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import label

from stages.data import Array, Cell, ElevationMap, NavigationMap, Reason
from stages.kernels.footprint import fit_planes
from stages.stage import Stage, parameter

# A plane's height at the cell must be known at least as well as the mean of four cells.
_LEVERAGE = 0.25
# How far above the wide plane ground may lie, round by round, in shares of max_step: first hardly at all, so that the
# plane sinks off the rocks, whose sides and tops would else hold it up.
_ABOVE = (0.05, 0.05, 0.15, 0.15, 0.15)
# How far below the wide plane ground may lie in the end: deeper is a pit, which would pull the narrow planes down.
_BELOW = 0.5
# How far off the footprint's plane ground may lie, both ways. Ground is found anew each round, and with it a crest that
# bends away from the wide plane comes back, from its sides inwards.
_ABOUT = (0.25, 0.25, 0.25)
# Rounding of float32 heights must not push a slope over its limit.
_SLOPE_ROUNDING = 1e-3


@dataclass(frozen=True)
class Binarise(Stage):
    """Classifies each cell as free, hazard or unknown, with the reason.

    method "footprint": a hazard is a cell that
    - STEP: reaches `max_step` above the ground about it, or below, or within itself, or is part of an obstacle that
      does: off the ground by `skirt` and joined to such a cell by others like it;
    - SLOPE: lies on ground steeper than `max_slope` over the rover's footprint;
    - ROUGHNESS: has heights about it whose root mean square off their plane exceeds `max_roughness`.
    A cell is unknown (UNOBSERVED), unless it is a hazard on its own showing, where it has no points, where so few cells
    lie about it that the ground is not determined, and where the layer `variance`, if the map has it, does not say that
    the height is known to `max_sigma`: what could be a step is not free.

    Ground wider than `surroundings` is terrain, not an obstacle: its edge is a hazard, its top is judged on its own.

    method "absolute", the paper's: a hazard is a cell whose elevation exceeds `max_step` (ELEVATION); all others with
    points are free, however little is known of their height.
    """

    method: str = parameter("footprint", "hazard rule", choices=("footprint", "absolute"))
    max_step: float = parameter(0.2, "height of a step, or elevation, that is a hazard", unit="m", low=0.01)
    max_slope: float = parameter(0.349, "steepest slope that is free (20 degrees)", unit="rad", low=0.0, high=1.5)
    max_roughness: float = parameter(0.06, "root mean square of heights off their plane", unit="m", low=0.0)
    footprint: float = parameter(1.0, "width of the rover: the window of a local plane", unit="m", low=0.05)
    surroundings: float = parameter(2.5, "width of the window in which an obstacle stands out", unit="m", low=0.05)
    margin: float = parameter(
        0.03, "a step this close to max_step counts as reaching it: cells blunt a peak", unit="m", low=0.0
    )
    skirt: float = parameter(
        0.05, "a cell this far off the ground belongs to the obstacle that it touches", unit="m", low=0.01
    )
    max_sigma: float = parameter(
        0.067, "standard deviation of a cell's height beyond which it is not free (3 are a step)", unit="m", low=0.0
    )
    min_points: int = parameter(1, "points without which a cell is unknown, where the map counts them", low=1)

    def __call__(self, elevation: ElevationMap) -> NavigationMap:
        """The navigation map on the grid of `elevation`."""
        height = elevation.layers["elevation"].astype(np.float64)
        observed = np.isfinite(height)
        if "count" in elevation.layers:
            observed &= elevation.layers["count"] >= self.min_points
        if self.method == "absolute":
            reason = np.where(observed & (height > self.max_step), Reason.ELEVATION, Reason.CLEAR)
            reason = np.where(observed, reason, Reason.UNOBSERVED)
        else:
            reason = self._footprint(elevation, np.where(observed, height, 0.0), observed)
        cells = np.full(reason.shape, Cell.HAZARD, np.int8)
        cells[reason == Reason.CLEAR] = Cell.FREE
        cells[reason == Reason.UNOBSERVED] = Cell.UNKNOWN
        return NavigationMap(
            elevation.stamp, cells, reason.astype(np.uint8), elevation.resolution, elevation.origin, elevation.frame_id
        )

    def _footprint(self, elevation: ElevationMap, height: Array, observed: Array) -> Array:
        level, slope, known = self._ground(height, observed, elevation.resolution)
        step = observed & self._step(elevation, height, level)
        step = _whole_obstacles(step, observed & (np.abs(height - level) >= self.skirt))
        passable = observed & ~step
        radius = _cells(self.footprint, elevation.resolution)
        roughness = fit_planes(height, passable, radius, _LEVERAGE)[3]

        reason = np.full(height.shape, Reason.UNOBSERVED)
        reason[passable & known & np.isfinite(roughness) & self._sure(elevation)] = Reason.CLEAR
        reason[passable & (roughness > self.max_roughness)] = Reason.ROUGHNESS
        reason[passable & known & (slope > self.max_slope + _SLOPE_ROUNDING)] = Reason.SLOPE
        reason[step] = Reason.STEP
        return reason

    def _ground(self, height: Array, observed: Array, resolution: float) -> tuple[Array, Array, Array]:
        """Height of the ground under each cell, its slope in radians, and where the footprint's plane is known.

        Where it is not (the middle of a large rock), the height is that of the surroundings' plane.
        """
        wide = _cells(max(self.surroundings, self.footprint), resolution)
        near = _cells(self.footprint, resolution)
        ground = observed
        for share in _ABOVE:
            around = fit_planes(height, ground, wide, _LEVERAGE)
            ground = observed & ~(height - around[0] > share * self.max_step)
        ground &= ~(around[0] - height > _BELOW * self.max_step)
        for share in _ABOUT:
            local = fit_planes(height, ground, near, _LEVERAGE)
            level = np.where(np.isfinite(local[0]), local[0], around[0])
            ground = observed & (np.abs(height - level) <= share * self.max_step)
        local = fit_planes(height, ground, near, _LEVERAGE)
        known = np.isfinite(local[0])
        slope = np.arctan(np.hypot(local[1], local[2]) / resolution)
        return np.where(known, local[0], around[0]), slope, known

    def _sure(self, elevation: ElevationMap) -> Array:
        """Cells whose height is known well enough to be called free, (rows, cols) bool."""
        if "variance" not in elevation.layers:
            return np.ones(elevation.shape, bool)
        return elevation.layers["variance"] <= self.max_sigma**2

    def _step(self, elevation: ElevationMap, height: Array, level: Array) -> Array:
        """Cells that reach `max_step` from the ground. Heights compare false where the ground is not known.

        One stray point must not make a hazard: the extreme counts where the mean agrees, by a quarter, that the cell is
        off the ground.
        """
        limit = self.max_step - self.margin
        top, bottom = (_finite(elevation.layers.get(extreme), height) for extreme in ("maximum", "minimum"))
        above = (top - level >= limit) & (height - level >= limit / 4)
        below = (level - bottom >= limit) & (level - height >= limit / 4)
        within = (top - bottom >= limit) & (height - bottom >= limit / 4) & (top - height >= limit / 4)
        return above | below | within


def _whole_obstacles(peaks: Array, raised: Array) -> Array:
    """The cells of all connected sets of `raised` cells that have one of `peaks` among them, (rows, cols) bool."""
    obstacles, _ = label(raised | peaks, np.ones((3, 3)))
    dangerous = np.bincount(obstacles[peaks], minlength=obstacles.max() + 1) > 0
    dangerous[0] = False
    return dangerous[obstacles]  # type: ignore[no-any-return]


def _finite(layer: Array | None, height: Array) -> Array:
    """A layer of heights as float64, with `height` where it is missing or not finite."""
    return height if layer is None else np.where(np.isfinite(layer), layer, height)


def _cells(width: float, resolution: float) -> int:
    """Half a window's width in whole cells, at least one."""
    return max(1, round(width / resolution / 2))
