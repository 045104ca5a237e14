"""TerrainFeatures: ground, step, slope, roughness and drop layers (paper section 4, slope filtering).

Everything is measured against the ground instead of gravity, so tilting or raising the whole scene changes nothing. The
ground is found with planes, first wide and then as wide as the rover. Each plane is fitted to the cells that the plane
before called ground, so a rock stands out of the ground instead of bending it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import reduce
from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt, find_objects, label

from stages.data import Array, ElevationMap, Rover
from stages.stage import Stage, parameter
from stages.terrain.kernels.local_minimum import local_minimum
from stages.terrain.kernels.plane_window import window_planes

SURROUNDINGS = 2.5  # m, width of the window in which an obstacle stands out
OBSTACLE_SHARE = 0.85  # of the rover's max_step, because cells blunt a peak
MAX_EXTREME = 4.0  # how far an extreme counts, over the mean: one stray point is no step
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
    """The ground below the cells, (rows, cols) each unless noted."""

    height: Array  # m, of the plane between the wheels
    wide: Array  # m, of the plane of the surroundings
    trend: Array  # (2, rows, cols), slope of the surroundings, rise per cell
    slope: Array  # rad, under the footprint
    planes: Array  # (3, rows, cols), height and slopes between the wheels; NaN in cells that are not ground


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
    min_skirt_height: float = parameter(
        0.05, "a cell this far off the ground belongs to the obstacle that it touches", unit="m", low=0.01
    )

    @property
    def min_obstacle_height(self) -> float:
        """Height above the ground, m, from which a cell is an obstacle."""
        return OBSTACLE_SHARE * self.rover.max_step

    def __call__(self, elevation: ElevationMap) -> ElevationMap:
        """The map with the layers added."""
        window = self._window(elevation)
        within = replace(elevation, layers={name: layer[window] for name, layer in elevation.layers.items()})
        layers = dict(elevation.layers)
        for name, layer in self._features(within).items():
            layers[name] = np.full(elevation.shape, np.nan, np.float32)
            layers[name][window] = layer
        return replace(elevation, layers=layers)

    def _window(self, elevation: ElevationMap) -> tuple[slice, slice]:
        """The rows and columns of the observed cells, widened by the widest window."""
        found = find_objects(np.isfinite(elevation.layers["elevation"]).astype(np.int8))
        widest = max(SURROUNDINGS, self.rover.footprint, self.rover.wheel_track)
        margin = _cells(widest / 2, elevation.resolution)
        rows, cols = found[0] if found else (slice(0, 1), slice(0, 1))
        first_row, first_col = max(rows.start - margin, 0), max(cols.start - margin, 0)
        return slice(first_row, rows.stop + margin), slice(first_col, cols.stop + margin)

    def _features(self, elevation: ElevationMap) -> dict[str, Array]:
        """The new layers, (rows, cols)."""
        height = elevation.layers["elevation"].astype(np.float64)
        observed = np.isfinite(height)
        height = np.where(observed, height, 0.0)
        ground = self._ground(height, observed, elevation.resolution)
        step, support = self._step(elevation, height, observed, ground)
        passable = observed & ~(step >= self.min_obstacle_height)
        wheel, footprint = (
            _cells(width / 2, elevation.resolution) for width in (self.rover.wheel, self.rover.footprint)
        )
        steepness = window_planes(height, passable, wheel, _MAX_WHEEL_VARIANCE)
        roughness = window_planes(height, passable, footprint, _MAX_VARIANCE)[3]
        layers = {
            "ground": ground.height,
            "step": step,
            "slope": np.where(observed, ground.slope, np.nan),
            "steepness": np.where(passable, _slope(steepness, elevation.resolution), np.nan),
            "roughness": np.where(observed, roughness, np.nan),
            "support": np.where(observed, support, np.nan),
        }
        if "ceiling" in elevation.layers:
            expected = np.fmax(ground.wide, _extrapolated(ground.planes, elevation.resolution))
            layers["drop"] = np.where(observed, np.nan, expected - elevation.layers["ceiling"])
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
        for above, below in _WIDE_BANDS:
            around = window_planes(height, ground, wide, _MAX_VARIANCE)
            off = height - around[0]
            ground = observed & ~((off > above * obstacle) | (off < -below * obstacle))
        for share in _NARROW_BANDS:
            local = window_planes(height, ground, narrow, _MAX_VARIANCE)
            level = np.where(np.isfinite(local[0]), local[0], around[0])
            ground = observed & (np.abs(height - level) <= share * obstacle)
        local = window_planes(height, ground, narrow, _MAX_VARIANCE)
        under = local if footprint == narrow else window_planes(height, ground, footprint, _MAX_VARIANCE)
        level = np.where(np.isfinite(local[0]), local[0], around[0])
        trend, planes = self._trend(around[1:3], resolution), np.where(ground, local[:3], np.nan)
        return _Ground(level, around[0], trend, _slope(under, resolution), planes)

    def _trend(self, slopes: Array, resolution: float) -> Array:
        """The slopes (2, rows, cols), rise per cell, limited to the rover's max_slope; 0 where unknown."""
        steep = np.hypot(*slopes) / (np.tan(self.rover.max_slope) * resolution + 1e-12)
        return np.where(np.isfinite(steep), slopes / np.maximum(steep, 1.0), 0.0)

    def _step(self, elevation: ElevationMap, height: Array, observed: Array, ground: _Ground) -> tuple[Array, Array]:
        """The layers `step` and `support`."""
        lowest, support = local_minimum(height, observed, ground.trend, _cells(self.rover.wheel, elevation.resolution))
        top, bottom = (_finite(elevation.layers.get(extreme), height) for extreme in ("maximum", "minimum"))
        rise = np.minimum(top - lowest, MAX_EXTREME * (height - lowest))
        above = np.minimum(top - ground.height, MAX_EXTREME * (height - ground.height))
        below = np.minimum(ground.height - bottom, MAX_EXTREME * (ground.height - height))
        explained = np.abs(ground.trend).sum(axis=0)  # from one corner of a cell to the opposite one
        within = np.minimum(top - bottom - explained, MAX_EXTREME * np.minimum(height - bottom, top - height))
        step = reduce(np.fmax, [rise, above, below, within, np.zeros_like(height)])
        off_ground = np.abs(height - ground.height) >= self.min_skirt_height
        raised = observed & (off_ground | (step >= self.min_obstacle_height))
        return np.where(observed, _as_whole_obstacles(step, raised), np.nan), support


def _extrapolated(planes: Array, resolution: float) -> Array:
    """Least height of the nearest ground plane extrapolated to each cell, NaN far from ground; planes: (3, rows, cols)
    of height, m, and rise per cell along columns and rows."""
    known = np.isfinite(planes[0])
    if not known.any():
        return np.full(known.shape, np.nan)
    distance, (row, col) = distance_transform_edt(~known, return_indices=True)
    rows, cols = np.indices(known.shape)
    height, along, across = planes[:, row, col]
    extrapolated = height + along * (cols - col) + across * (rows - row) - _EXTRAPOLATION_ERROR
    return np.where(distance * resolution <= _MAX_EXTRAPOLATION, extrapolated, np.nan)


def _as_whole_obstacles(step: Array, raised: Array) -> Array:
    """The steps (rows, cols), with the largest of an obstacle in all its 8-connected `raised` cells."""
    obstacle, _ = label(raised, np.ones((3, 3)))
    highest = np.zeros(obstacle.max() + 1)
    np.maximum.at(highest, obstacle[raised], step[raised])
    return np.where(raised, highest[obstacle], step)


def _slope(plane: Array, resolution: float) -> Array:
    """Slope, rad, of planes (4, rows, cols) of `window_planes`."""
    return np.asarray(np.arctan(np.hypot(plane[1], plane[2]) / resolution))


def _finite(layer: Array | None, height: Array) -> Array:
    """A layer of heights as float64, with `height` where it is missing or not finite."""
    return height if layer is None else np.where(np.isfinite(layer), layer, height).astype(np.float64)


def _cells(distance: float, resolution: float) -> int:
    """A distance in whole cells, at least one."""
    return max(1, round(distance / resolution))
