"""Grid maps: elevation with its layers, and navigation with the reason for each cell."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from types import MappingProxyType

import numpy as np

from flow.contracts import StageError
from stages.data.arrays import Array, check_resolution, publish, publish_stamp, read_only
from stages.data.motion import Transform

LEVEL_FRAME = "level"


class Cell(IntEnum):
    """The three states of `NavigationMap.cells`."""

    UNKNOWN = -1
    FREE = 0
    HAZARD = 100


class CellReason(IntEnum):
    """Why a navigation cell has its state, the codes of `NavigationMap.reason`."""

    CLEAR = 0
    UNOBSERVED = 1
    ELEVATION = 2
    STEP = 3
    SLOPE = 4
    ROUGHNESS = 5
    CLEARANCE = 6  # it would touch the rover's belly
    BESIDE = 7  # next to a hazard, by less than where heights lie is known
    OCCLUDED = 8  # unknown: hidden from the cameras, or not matched, amid ground that was measured
    UNSURE = 9  # unknown: measured, but on too little evidence


@dataclass(frozen=True, eq=False)
class ElevationMap:
    """A 2.5-D terrain grid: row index grows with y, column index with x.

    layers: name -> (rows, cols) float32, NaN = unknown, all of one shape, among them "elevation" (m);
    resolution: cell size, m; origin: (x, y) of the lower-left corner of cell [0, 0], m; level: for a map in another
    frame, where the frame `level` of that stamp lies in it; epoch: for a map of many frames, the stamp, ns, from which
    its layers "first" and "last" count seconds.
    """

    stamp: int
    layers: Mapping[str, Array]
    resolution: float
    origin: tuple[float, float]
    frame_id: str
    level: Transform | None = None
    epoch: int | None = None
    shape: tuple[int, int] = field(init=False)

    def __post_init__(self) -> None:
        publish_stamp(self)
        check_resolution(self)
        layers = {name: np.asarray(layer) for name, layer in self.layers.items()}
        if "elevation" not in layers:
            raise StageError("ElevationMap has no layer 'elevation'")
        rows, cols = layers["elevation"].shape
        for name, layer in layers.items():
            if layer.shape != (rows, cols) or layer.dtype != np.float32:
                raise StageError(f"ElevationMap layer '{name}' must be float32 ({rows}, {cols})")
        object.__setattr__(self, "layers", MappingProxyType({n: read_only(layer) for n, layer in layers.items()}))
        object.__setattr__(self, "shape", (rows, cols))


@dataclass(frozen=True, eq=False)
class NavigationMap:
    """Where the rover may drive.

    cells: (rows, cols) int8, codes of `Cell`; reason: (rows, cols) uint8, codes of `CellReason`; resolution, m, and
    origin, m, as in `ElevationMap`.
    """

    stamp: int
    cells: Array
    reason: Array
    resolution: float
    origin: tuple[float, float]
    frame_id: str

    def __post_init__(self) -> None:
        publish_stamp(self)
        check_resolution(self)
        publish(self, "cells", (None, None), np.int8)
        publish(self, "reason", self.cells.shape, np.uint8)
