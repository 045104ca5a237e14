"""TerrainFeatures: ground, step, slope, roughness and drop layers (paper section 4, slope filtering).

Everything is measured against the ground instead of gravity, so tilting or raising the whole scene changes nothing. The
ground is found with planes, first wide and then as wide as the rover. Each plane is fitted to the cells that the plane
before called ground, so a rock stands out of the ground instead of bending it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from stages.data import Array, ElevationMap, Rover
from stages.data.arrays import Span, spanned
from stages.stage import Stage, check_types, parameter
from stages.terrain.kernels.cell_steps import cell_steps
from stages.terrain.kernels.local_minimum import local_minimum
from stages.terrain.kernels.nearest_known import nearest_known
from stages.terrain.kernels.plane_window import window_planes

SURROUNDINGS = 2.5  # m, width of the window in which an obstacle stands out
MIN_SKIRT_HEIGHT = 0.05  # m; a cell this far off the ground belongs to the obstacle that it touches
OBSTACLE_SHARE = 0.85  # of the rover's max_step, because cells blunt a peak
# Largest variance of a plane's height at the cell, over one cell's: four cells. No ratio of small integers equals it,
# so rounding does not decide. Under a wheel there are few cells, and only the slope counts.
_MAX_VARIANCE, _MAX_WHEEL_VARIANCE = 0.2503, 0.3503
# Distance of ground above and below the wide plane in each round, over the obstacle height. Both sides, so that a ditch
# is no more ground than a row of rocks. More below, because rocks are many and pits are few. From wide to narrow,
# because the first plane is fitted to obstacles too.
_WIDE_BANDS = ((0.4, 0.8), (0.25, 0.6), (0.18, 0.6), (0.18, 0.6), (0.18, 0.6))
# The same for the plane between the wheels. Each round recovers more of a crest that bends away from the wide plane.
_NARROW_BANDS = (0.3, 0.3, 0.3)
_MAX_EXTRAPOLATION, _EXTRAPOLATION_ERROR = 0.5, 0.03  # m: of ground into hidden cells


class _Ground(NamedTuple):
    """The ground below the cells, (rows, cols) each unless noted. Planes: height and slopes, rise per cell."""

    height: Array  # m, of the plane between the wheels
    wide: Array  # (3, rows, cols), planes of the surroundings
    under: Array  # (3, rows, cols), planes under the footprint
    between: Array  # (3, rows, cols), planes between the wheels
    known: Array  # bool, cells of the ground whose plane between the wheels is known


@dataclass(frozen=True)
class TerrainFeatures(Stage):
    """Adds the layers ground, step, slope, steepness, roughness and support to an elevation map.

    Adds drop if the map has the layer ceiling. docs/terrain.md defines the layers.

    Examples
    --------
    >>> heights = np.zeros((40, 40), np.float32)
    >>> heights[20, 20] = 0.3
    >>> terrain = TerrainFeatures()(ElevationMap(0, {"elevation": heights}, 0.05, (0.0, 0.0), "level"))
    >>> round(float(terrain.layers["step"][20, 20]), 3), round(float(terrain.layers["ground"][20, 20]), 3)
    (0.3, 0.0)
    """

    rover: Rover = parameter(Rover(), "the vehicle")

    @property
    def min_obstacle_height(self) -> float:
        """Height above the ground, m, from which a cell is an obstacle."""
        return OBSTACLE_SHARE * self.rover.max_step

    def __call__(self, elevation: ElevationMap) -> ElevationMap:
        """The map with the layers added."""
        check_types(self, elevation=elevation)
        around, inside = self._windows(elevation)
        within = replace(elevation, layers={name: layer[around] for name, layer in elevation.layers.items()})
        layers = dict(elevation.layers)
        for name, layer in self._features(within, inside).items():
            layers[name] = np.full(elevation.shape, np.nan, np.float32)
            layers[name][around] = layer
        return replace(elevation, layers=layers)

    def _windows(self, elevation: ElevationMap) -> tuple[Span, Span]:
        """The observed cells widened by the widest window, and where the observed cells are in that."""
        observed = np.isfinite(elevation.layers["elevation"])
        widest = max(SURROUNDINGS, self.rover.footprint, self.rover.wheel_track)
        margin = _cells(widest / 2, elevation.resolution)
        (rows, cols), around = spanned(observed), spanned(observed, margin)
        row, col = (each.start for each in around)
        return around, (slice(rows.start - row, rows.stop - row), slice(cols.start - col, cols.stop - col))

    def _features(self, elevation: ElevationMap, inside: Span) -> dict[str, Array]:
        """The new layers, (rows, cols); inside: where the observed cells are."""
        height = elevation.layers["elevation"].astype(np.float64)
        observed = np.isfinite(height)
        height = np.where(observed, height, 0.0)
        ground = self._ground(height, observed, elevation.resolution)
        step, support = (np.full(height.shape, np.nan) for _ in range(2))
        step[inside], support[inside] = self._step(elevation, height, observed, ground, inside)
        passable = observed & ~(step >= self.min_obstacle_height)
        wheel, footprint = (
            _cells(width / 2, elevation.resolution) for width in (self.rover.wheel, self.rover.footprint)
        )
        steepness = window_planes(height, passable, wheel, _MAX_WHEEL_VARIANCE, passable)
        roughness = window_planes(height, passable, footprint, _MAX_VARIANCE, observed)[3]
        layers = {
            "ground": ground.height,
            "step": step,
            "slope": _slope(ground.under, observed, elevation.resolution),
            "steepness": _slope(steepness, passable, elevation.resolution),
            "roughness": np.where(observed, roughness, np.nan),
            "support": support,
        }
        if "ceiling" in elevation.layers:
            hidden = ~observed & np.isfinite(elevation.layers["ceiling"])
            extrapolated = _extrapolated(ground.between, ground.known, hidden, elevation.resolution)
            expected = np.fmax(ground.wide[0][hidden], extrapolated)
            layers["drop"] = np.full(height.shape, np.nan)
            layers["drop"][hidden] = expected - elevation.layers["ceiling"][hidden]
        return layers

    def _ground(self, height: Array, observed: Array, resolution: float) -> _Ground:
        """The ground below the cells.

        Where no plane between the wheels is known, as in the middle of a large rock, the height is that of the wide
        plane.
        """
        wide = _cells(max(SURROUNDINGS, self.rover.footprint) / 2, resolution)
        narrow = _cells(self.rover.wheel_track / 2, resolution)
        footprint = _cells(self.rover.footprint / 2, resolution)
        obstacle = self.min_obstacle_height
        ground = observed
        for count, (above, below) in enumerate(_WIDE_BANDS, 1):
            asked = observed if count < len(_WIDE_BANDS) else None
            around = window_planes(height, ground, wide, _MAX_VARIANCE, asked)
            off = height - around[0]
            ground = observed & ~((off > above * obstacle) | (off < -below * obstacle))
        for share in _NARROW_BANDS:
            local = window_planes(height, ground, narrow, _MAX_VARIANCE, observed)
            level = np.where(np.isfinite(local[0]), local[0], around[0])
            ground = observed & (np.abs(height - level) <= share * obstacle)
        local = window_planes(height, ground, narrow, _MAX_VARIANCE)
        under = local if footprint == narrow else window_planes(height, ground, footprint, _MAX_VARIANCE, observed)
        level = np.where(np.isfinite(local[0]), local[0], around[0])
        return _Ground(level, around[:3], under[:3], local[:3], ground & np.isfinite(local[0]))

    def _trend(self, slopes: Array, resolution: float) -> Array:
        """The slopes (2, rows, cols), rise per cell, limited to the rover's max_slope; 0 where unknown."""
        steep = np.hypot(*slopes) / (np.tan(self.rover.max_slope) * resolution + 1e-12)
        return np.where(np.isfinite(steep), slopes / np.maximum(steep, 1.0), 0.0)

    def _step(
        self, elevation: ElevationMap, height: Array, observed: Array, ground: _Ground, inside: Span
    ) -> tuple[Array, Array]:
        """The layers `step` and `support` of the window `inside`, which contains all observed cells."""
        height, observed, level = height[inside], observed[inside], ground.height[inside]
        trend = self._trend(ground.wide[1:, *inside], elevation.resolution)
        lowest, support = local_minimum(height, observed, trend, _cells(self.rover.wheel, elevation.resolution))
        top, bottom = (
            elevation.layers.get(name, elevation.layers["elevation"])[inside] for name in ("maximum", "minimum")
        )
        step = cell_steps(height, observed, top, bottom, lowest, level, trend)
        raised = observed & ((np.abs(height - level) >= MIN_SKIRT_HEIGHT) | (step >= self.min_obstacle_height))
        return _as_whole_obstacles(step, raised), np.where(observed, support, np.nan)


def _extrapolated(planes: Array, known: Array, where: Array, resolution: float) -> Array:
    """Least height of the nearest `known` plane extrapolated to the cells `where`, (n,), NaN far from it; planes: (3,
    rows, cols) of height, m, and rise per cell along columns and rows."""
    rows, cols = np.divmod(np.flatnonzero(where), where.shape[1])
    row, col, distance = nearest_known(known, rows, cols, _cells(_MAX_EXTRAPOLATION, resolution))
    near = distance * resolution <= _MAX_EXTRAPOLATION
    extrapolated = np.full(len(rows), np.nan)
    height, along, across = planes.reshape(3, -1).take(row[near] * where.shape[1] + col[near], axis=1)
    extrapolated[near] = height + along * (cols - col)[near] + across * (rows - row)[near] - _EXTRAPOLATION_ERROR
    return extrapolated


def _as_whole_obstacles(step: Array, raised: Array) -> Array:
    """The steps (rows, cols), with the largest of an obstacle in all its 8-connected `raised` cells."""
    if not raised.any():
        return step
    count, obstacle = cv2.connectedComponents(raised.view(np.uint8), connectivity=8)
    highest = np.zeros(count)
    np.maximum.at(highest, obstacle[raised].astype(np.intp), step[raised])
    return np.where(raised, highest[obstacle], step)


def _slope(planes: Array, where: Array, resolution: float) -> Array:
    """Slope (rows, cols), rad, of planes of `window_planes` in the cells `where`; NaN in the others."""
    slope = np.full(where.shape, np.nan)
    slope[where] = np.arctan(np.hypot(planes[1][where], planes[2][where]) / resolution)
    return slope


def _cells(distance: float, resolution: float) -> int:
    """A distance in whole cells, at least one."""
    return max(1, round(distance / resolution))
