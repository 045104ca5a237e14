"""Grid maps: elevation with its layers, and navigation with the reason for each cell."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, NoReturn

import numpy as np

from flow.contracts import StageError
from stages.data.arrays import Array, check_resolution, publish, publish_plain, read_only
from stages.data.motion import Transform

LEVEL_FRAME = "level"
RIM_WIDTH = 1.5  # m at the edges of a window of a larger map; slopes and steps are measured over less


class Cell(IntEnum):
    """The three states of `NavigationMap.cells`."""

    UNKNOWN = -1
    FREE = 0
    HAZARD = 100


class CellReason(IntEnum):
    """Why a navigation cell has its state: the codes of `NavigationMap.reason`."""

    CLEAR = 0
    UNOBSERVED = 1
    ELEVATION = 2  # the paper's rule
    STEP = 3
    SLOPE = 4
    ROUGHNESS = 5
    CLEARANCE = 6  # it would touch the rover's belly
    BESIDE = 7  # next to an obstacle, closer than its outline is known
    OCCLUDED = 8  # unknown: hidden from the cameras, between or behind measured ground
    UNSURE = 9  # unknown: measured, but on too little evidence
    UNMATCHED = 10  # unknown: in the image, but its pixels were not matched


class MatchFailure(IntEnum):
    """Why the pixels of a cell were not matched: the codes of the layer `unmatched`."""

    DARK = 1
    BURNT_OUT = 2
    BARE = 3  # without contrast
    OTHER = 4  # seen by one camera, repetitive, reflecting


class _Layers(dict[str, Array]):
    """A dict that cannot be changed; pickles and copies of it can."""

    def _refuse(self, *args: Any, **kwargs: Any) -> NoReturn:
        raise TypeError("the layers of an ElevationMap are read-only; make another map with dataclasses.replace")

    __setitem__ = __delitem__ = __ior__ = update = setdefault = pop = popitem = clear = _refuse

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (dict(self),)


@dataclass(frozen=True, eq=False)
class ElevationMap:
    """A 2.5-D terrain grid: the row index grows with y, the column index with x.

    Parameters
    ----------
    layers : mapping of str to (rows, cols) float32
        All of one shape; NaN is unknown. "elevation" (m) is required; docs/terrain.md lists the others.
    resolution : float
        Cell size, m.
    origin : (float, float)
        (x, y) of the lower-left corner of cell [0, 0], m.
    level : Transform, optional
        Frame `level` of that stamp in `frame_id`, for a map in another frame.
    epoch : int, optional
        Stamp, ns, from which the layers "first" and "last" of a fused map count seconds.

    Examples
    --------
    >>> ElevationMap(0, {"elevation": np.zeros((2, 3), np.float32)}, 0.05, (0.0, 0.0), "level").shape
    (2, 3)
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
        publish_plain(self)
        check_resolution(self)
        layers = {name: np.asarray(layer) for name, layer in self.layers.items()}
        if "elevation" not in layers:
            raise StageError("ElevationMap has no layer 'elevation'")
        if layers["elevation"].ndim != 2:
            raise StageError(f"ElevationMap layer 'elevation' must be (rows, cols), not {layers['elevation'].shape}")
        rows, cols = layers["elevation"].shape
        for name, layer in layers.items():
            if layer.shape != (rows, cols) or layer.dtype != np.float32:
                raise StageError(f"ElevationMap layer '{name}' must be float32 ({rows}, {cols})")
        object.__setattr__(self, "layers", _Layers({n: read_only(layer) for n, layer in layers.items()}))
        object.__setattr__(self, "shape", (rows, cols))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled and copied by its fields, so that its arrays are read-only again."""
        fields = self.stamp, self.layers, self.resolution, self.origin, self.frame_id, self.level, self.epoch
        return type(self), fields


@dataclass(frozen=True, eq=False)
class NavigationMap:
    """Where the rover may drive; `resolution` and `origin` are as in `ElevationMap`.

    Parameters
    ----------
    cells : (rows, cols) int8
        Codes of `Cell`.
    reason : (rows, cols) uint8
        Codes of `CellReason`.

    Examples
    --------
    >>> cells, reason = np.int8([[Cell.FREE, Cell.HAZARD]]), np.uint8([[CellReason.CLEAR, CellReason.STEP]])
    >>> NavigationMap(0, cells, reason, 0.05, (0.0, 0.0), "level").cells.tolist()
    [[0, 100]]
    """

    stamp: int
    cells: Array
    reason: Array
    resolution: float
    origin: tuple[float, float]
    frame_id: str

    def __post_init__(self) -> None:
        publish_plain(self)
        check_resolution(self)
        publish(self, "cells", (None, None), np.int8)
        publish(self, "reason", self.cells.shape, np.uint8)


def cell_centres(grid: ElevationMap) -> tuple[Array, Array]:
    """x of each column (cols,) and y of each row (rows,) of a grid, m."""
    rows, cols = grid.shape
    left, bottom = grid.origin
    return left + (np.arange(cols) + 0.5) * grid.resolution, bottom + (np.arange(rows) + 0.5) * grid.resolution
