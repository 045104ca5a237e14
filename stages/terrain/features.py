"""TerrainFeatures: what terrain would do to a rover, as layers of the elevation map (paper section 4, slope filtering).

The trick is to measure everything against the ground and not against gravity: a rise against what lies within a wheel's
reach, a height against the plane between the wheels, roughness off the footprint's plane. The ground is found by
planes, first wide and then the rover's size, each time fitted to the cells that the plane before called ground, so that
a rock stands out of the ground instead of bending it. None of it changes when the whole scene is tilted or raised.
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

MOST = 0.85  # share of `max_step`: cells blunt a peak
# A plane's height at the cell must be known about as well as the mean of four cells. No ratio of small integers equals
# it, so that rounding does not decide.
_LEVERAGE = 0.2503
# Under a wheel there are few cells, and it is the slope that counts.
_WHEEL_LEVERAGE = 0.3503
# How far above and below the wide plane ground may lie, round by round, in shares of `obstacle`. Both ways, so that a
# ditch is as little ground as a row of rocks, whichever covers less than the ground does; farther below than above,
# for rocks are many and pits are few, and from wide to narrow, for the first plane leans on all of them.
_WITHIN = ((0.4, 0.8), (0.25, 0.6), (0.18, 0.6), (0.18, 0.6), (0.18, 0.6))
# How far ground is carried on into what is hidden, m, and by how much rolling ground is off then, m.
_CARRIED, _CARRIED_ERROR = 0.5, 0.03
# How far off the plane between the wheels ground may lie, both ways. Ground is found anew each round, and with it a
# crest that bends away from the wide plane comes back, from its sides inwards.
_ABOUT = (0.3, 0.3, 0.3)


class _Ground(NamedTuple):
    """The ground under the cells, (rows, cols) each but for two."""

    height: Array  # m, by the plane between the wheels
    wide: Array  # m, by that of the surroundings
    trend: Array  # (2, rows, cols), slope of the surroundings, rise per cell
    slope: Array  # rad, under the footprint
    planes: Array  # (3, rows, cols), those between the wheels: height and slopes; NaN in cells that are no ground


@dataclass(frozen=True)
class TerrainFeatures(Stage):
    """Adds to an elevation map, where they can be told:

    - ground, m: height of the ground under a cell, its own obstacle not counted, and under small holes too;
    - step, m: how far the cell reaches from the ground, the largest of: its top above the lowest cell within a wheel's
      reach, what the slope of the surroundings explains taken off; its top above `ground`; its bottom below `ground`;
      its top above its bottom, that slope's rise within the cell taken off. One stray point makes no step: an extreme
      counts up to four times as far as the mean.
      An obstacle is as high as its highest cell: cells off the ground by `skirt` that join share the largest step;
    - slope, rad: of the ground under the footprint;
    - steepness, rad: of all that is no obstacle, under a wheel;
    - roughness, m: root mean square of the same off its plane under the footprint;
    - support: share of the cells within a wheel's reach that are known;
    - drop, m: how far below the ground of the surroundings a hidden cell lies at least, by the line of sight that
      passes over it, NaN in others; where the map says below what hidden cells lie (layer `ceiling`). That ground is
      the higher one of the surroundings' plane, for the far wall of a ditch would bend a narrower one, and of the
      nearest ground carried on, for the wide plane leans on what lies below a drop, where that is seen.
    """

    rover: Rover = parameter(Rover(), "the vehicle")
    surroundings: float = parameter(
        2.5, "width of the window in which an obstacle stands out", unit="m", low=0.05, high=50.0
    )
    skirt: float = parameter(
        0.05, "a cell this far off the ground belongs to the obstacle that it touches", unit="m", low=0.01
    )

    @property
    def obstacle(self) -> float:
        """How far from the ground that is, m."""
        return MOST * self.rover.max_step

    def __call__(self, elevation: ElevationMap) -> ElevationMap:
        """The map with the layers added."""
        window = self._window(elevation)
        within = replace(elevation, layers={name: layer[window] for name, layer in elevation.layers.items()})
        layers = dict(elevation.layers)
        for name, layer in self._assessed(within).items():
            layers[name] = np.full(elevation.shape, np.nan, np.float32)
            layers[name][window] = layer
        return replace(elevation, layers=layers)

    def _window(self, elevation: ElevationMap) -> tuple[slice, slice]:
        """The rows and columns that anything can be told of: those of the observed cells, and of the widest window."""
        found = find_objects(np.isfinite(elevation.layers["elevation"]).astype(np.int8))
        reach = _reach(max(self.surroundings, self.rover.footprint, self.rover.wheel_track) / 2, elevation.resolution)
        rows, cols = found[0] if found else (slice(0, 1), slice(0, 1))
        first_row, first_col = max(rows.start - reach, 0), max(cols.start - reach, 0)
        return slice(first_row, rows.stop + reach), slice(first_col, cols.stop + reach)

    def _assessed(self, elevation: ElevationMap) -> dict[str, Array]:
        """The layers, (rows, cols)."""
        height = elevation.layers["elevation"].astype(np.float64)
        observed = np.isfinite(height)
        height = np.where(observed, height, 0.0)
        ground = self._ground(height, observed, elevation.resolution)
        step, support = self._step(elevation, height, observed, ground)
        passable = observed & ~(step >= self.obstacle)
        wheel, footprint = (
            _reach(width / 2, elevation.resolution) for width in (self.rover.wheel, self.rover.footprint)
        )
        steepness = window_planes(height, passable, wheel, _WHEEL_LEVERAGE)
        roughness = window_planes(height, passable, footprint, _LEVERAGE)[3]
        layers = {
            "ground": ground.height,
            "step": step,
            "slope": np.where(observed, ground.slope, np.nan),
            "steepness": np.where(passable, _slope(steepness, elevation.resolution), np.nan),
            "roughness": np.where(observed, roughness, np.nan),
            "support": np.where(observed, support, np.nan),
        }
        if "ceiling" in elevation.layers:
            expected = np.fmax(ground.wide, _carried_on(ground.planes, elevation.resolution))
            layers["drop"] = np.where(observed, np.nan, expected - elevation.layers["ceiling"])
        return layers

    def _ground(self, height: Array, observed: Array, resolution: float) -> _Ground:
        """The ground under the cells.

        Where the plane between the wheels is not known (the middle of a large rock), the height is that of the
        surroundings' plane; where that is not known, a step is measured against the level.
        """
        wide = _reach(max(self.surroundings, self.rover.footprint) / 2, resolution)
        narrow = _reach(self.rover.wheel_track / 2, resolution)
        ground = observed
        for above, below in _WITHIN:
            around = window_planes(height, ground, wide, _LEVERAGE)
            off = height - around[0]
            ground = observed & ~((off > above * self.obstacle) | (off < -below * self.obstacle))
        for share in _ABOUT:
            local = window_planes(height, ground, narrow, _LEVERAGE)
            level = np.where(np.isfinite(local[0]), local[0], around[0])
            ground = observed & (np.abs(height - level) <= share * self.obstacle)
        local = window_planes(height, ground, narrow, _LEVERAGE)
        footprint = _reach(self.rover.footprint / 2, resolution)
        under = local if footprint == narrow else window_planes(height, ground, footprint, _LEVERAGE)
        level = np.where(np.isfinite(local[0]), local[0], around[0])
        trend, planes = self._trend(around[1:3], resolution), np.where(ground, local[:3], np.nan)
        return _Ground(level, around[0], trend, _slope(under, resolution), planes)

    def _trend(self, slopes: Array, resolution: float) -> Array:
        """The slopes (2, rows, cols), rise per cell, cut to `max_slope`; 0 where they are not known."""
        steep = np.hypot(*slopes) / (np.tan(self.rover.max_slope) * resolution + 1e-12)
        return np.where(np.isfinite(steep), slopes / np.maximum(steep, 1.0), 0.0)

    def _step(self, elevation: ElevationMap, height: Array, observed: Array, ground: _Ground) -> tuple[Array, Array]:
        """The layers `step` and `support`."""
        lowest, support = local_minimum(height, observed, ground.trend, _reach(self.rover.wheel, elevation.resolution))
        top, bottom = (_finite(elevation.layers.get(extreme), height) for extreme in ("maximum", "minimum"))
        rise = np.minimum(top - lowest, 4 * (height - lowest))
        above = np.minimum(top - ground.height, 4 * (height - ground.height))
        below = np.minimum(ground.height - bottom, 4 * (ground.height - height))
        explained = np.abs(ground.trend).sum(axis=0)  # from one corner of a cell to the opposite one
        within = np.minimum(top - bottom - explained, 4 * np.minimum(height - bottom, top - height))
        step = reduce(np.fmax, [rise, above, below, within, np.zeros_like(height)])
        raised = observed & ((np.abs(height - ground.height) >= self.skirt) | (step >= self.obstacle))
        return np.where(observed, _as_whole_obstacles(step, raised), np.nan), support


def _carried_on(planes: Array, resolution: float) -> Array:
    """Height, less what it may be off by, of the nearest plane, NaN where none is near: planes (3, rows, cols) of
    height, m, and rise per cell along columns and rows."""
    known = np.isfinite(planes[0])
    if not known.any():
        return np.full(known.shape, np.nan)
    distance, (row, col) = distance_transform_edt(~known, return_indices=True)
    rows, cols = np.indices(known.shape)
    height, along, across = planes[:, row, col]
    carried = height + along * (cols - col) + across * (rows - row) - _CARRIED_ERROR
    return np.where(distance * resolution <= _CARRIED, carried, np.nan)


def _as_whole_obstacles(step: Array, raised: Array) -> Array:
    """The steps (rows, cols), all `raised` cells that join, corners included, having the largest of theirs."""
    obstacle, _ = label(raised, np.ones((3, 3)))
    highest = np.zeros(obstacle.max() + 1)
    np.maximum.at(highest, obstacle[raised], step[raised])
    return np.where(raised, highest[obstacle], step)


def _slope(plane: Array, resolution: float) -> Array:
    """Slope, rad, of planes (4, rows, cols) as `window_planes` gives them."""
    return np.asarray(np.arctan(np.hypot(plane[1], plane[2]) / resolution))


def _finite(layer: Array | None, height: Array) -> Array:
    """A layer of heights as float64, with `height` where it is missing or not finite."""
    return height if layer is None else np.where(np.isfinite(layer), layer, height).astype(np.float64)


def _reach(distance: float, resolution: float) -> int:
    """A distance in whole cells, at least one."""
    return max(1, round(distance / resolution))
