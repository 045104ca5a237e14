"""MapRegion: the elevation map around the rover, once for each step driven.

The layers of a map, and the features and the navigation map after it, cost more than fusing a frame. A map contains
the changes of all frames before it, so few maps are enough.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stages.data import RIM_WIDTH, ElevationMap, Region
from stages.stage import Stage, check_cells, check_types, parameter
from stages.terrain.fused_map import layers_of

AHEAD = (4.0, 0.0, 0.0)  # m in frame `level`; the place that moves when the rover turns
MAX_GAP = 20.0  # m from one frame to the next that one map spans

Bounds = tuple[int, int, int, int]  # first row and column, end row and column


@dataclass(eq=False)
class MapProgress:
    """What `MapRegion` remembers. mapped: the region of the last map; held: a later one without a map; changed: the
    bounds of what the frames have changed since."""

    mapped: Region | None = None
    held: Region | None = None
    changed: Bounds | None = None


@dataclass(frozen=True)
class MapRegion(Stage):
    """Returns the map around the rover each time it has moved by `step`, and with the last frame; else None.

    The map is a square of `window` around the rover with its sides along the axes of the pose's frame, and larger where
    frames since the last map changed more. So the maps of a run laid over each other are the whole region. Where the
    region starts again, or the pose jumps by more than 20 m, the map of the frame before comes first if it has none;
    if that is the last frame of a run, it has no map. docs/terrain.md describes the layers.

    Examples
    --------
    >>> from stages import FuseRegion, Level, PointCloud, Pose, Tilt
    >>> cloud = PointCloud(0, np.float32([[0, 1, 3]]), np.zeros((1, 3), np.uint8), np.float32([0.01]), np.int32([0]),
    ...                    "camera")
    >>> level = Level()(cloud, Tilt(0, [0.0, -1.0, 0.0], "camera"))
    >>> fuse, maps, pose = FuseRegion(), MapRegion(), Pose(0, [5, 0, 1], [-0.5, 0.5, -0.5, 0.5], "odom", "camera")
    >>> terrain = maps(fuse(level, pose, state=fuse.start()), state=maps.start())
    >>> row, col = np.argwhere(np.isfinite(terrain.layers["elevation"]))[0]
    >>> round(terrain.origin[0] + 0.05 * (float(col) + 0.5), 3), round(float(terrain.layers["elevation"][row, col]), 3)
    (8.025, 0.0)
    """

    step: float = parameter(
        0.0, "distance moved by the rover, or by the point 4 m ahead of it, from map to map; 0: a map for every frame",
        unit="m", low=0.0, high=5.0,
    )  # fmt: skip
    window: float = parameter(20.0, "width of the map", unit="m", low=0.5, high=200.0)

    def start(self) -> MapProgress:
        """Nothing mapped yet."""
        return MapProgress()

    def __call__(self, region: Region, *, state: MapProgress) -> ElevationMap | None:
        """The map of a region in the pose's frame, or None."""
        check_types(self, region=region)
        check_cells("MapRegion.window", self.window, region.resolution)
        held, changed = state.held, state.changed
        if held is not None and changed is not None and _way(held, region) > MAX_GAP:
            state.mapped, state.held, state.changed = held, region, region.changed
            return map_around(held, self.window, changed)
        state.held, state.changed = region, _around(changed, region.changed)
        if state.mapped is None or _way(state.mapped, region) >= self.step:
            return self.flush(state)
        return None

    def flush(self, state: MapProgress) -> ElevationMap | None:
        """The map of the last region, if it has none."""
        held, changed = state.held, state.changed
        if held is None or changed is None:
            return None
        state.mapped, state.held, state.changed = held, None, None
        return map_around(held, self.window, changed)


def map_around(region: Region, window: float, changed: Bounds) -> ElevationMap:
    """The map of `window`, m, around the rover, and around what has changed."""
    step, half = region.resolution, math.ceil(window / 2 / region.resolution - 1e-9)
    margin = math.ceil(RIM_WIDTH / step - 1e-9)
    col, row = (math.floor(position / step) - half for position in region.level.translation[:2])
    first_row, first_col, end_row, end_col = changed
    wide = first_row - margin, first_col - margin, end_row + margin, end_col + margin
    row, col, end_row, end_col = _around((row, col, row + 2 * half, col + 2 * half), wide)
    layers = layers_of(region.cells.read(row, col, end_row - row, end_col - col), region.has_ceiling)
    origin = (col * step, row * step)
    return ElevationMap(region.stamp, layers, step, origin, region.frame_id, region.level, region.epoch)


def _way(one: Region, other: Region) -> float:
    """How far the rover is between two regions, m, or the place 4 m ahead of it; inf if they do not continue."""
    if (one.frame_id, one.epoch) != (other.frame_id, other.epoch):
        return math.inf
    before, after = (region.level(np.array([[0.0, 0.0, 0.0], AHEAD])) for region in (one, other))
    return float(np.linalg.norm((after - before)[:, :2], axis=1).max())


def _around(one: Bounds | None, other: Bounds) -> Bounds:
    """The bounds of both."""
    if one is None:
        return other
    return min(one[0], other[0]), min(one[1], other[1]), max(one[2], other[2]), max(one[3], other[3])
