"""Maps of a frame without the empty cells around what they know."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from stages.data import LEVEL_FRAME, RIM_WIDTH, Array, Cell, CellReason, ElevationMap, NavigationMap
from stages.data.arrays import Span, spanned

_Map = TypeVar("_Map", ElevationMap, NavigationMap)
Grid = tuple[str, tuple[float, float], float, tuple[int, ...]]  # frame, origin, resolution and shape
METRES_BEHIND = 1.0  # m behind the rover that a picture shows if nothing is known farther behind
COUNTS = {"count", "frames", "contradictions"}  # layers that are 0, not NaN, where nothing is known


def cropped(items: Mapping[str, Any]) -> dict[str, Any]:
    """The items of a frame, its maps on the smallest rectangle around their known cells.

    Maps on one grid get one rectangle. Regional maps keep a rim around it, because readers that lay windows over each
    other trust the cells at the edge of a window less. A map without known cells stays whole.
    """
    maps = {name: item for name, item in items.items() if isinstance(item, ElevationMap | NavigationMap)}
    known: dict[Grid, Array] = {}
    for item in maps.values():
        grid = _grid_of(item)
        known[grid] = known_cells(item) | known[grid] if grid in known else known_cells(item)
    windows = {grid: _window(cells, _rim(grid)) for grid, cells in known.items()}
    return dict(items) | {name: _part(item, *windows[_grid_of(item)]) for name, item in maps.items()}


def known_cells(grid: ElevationMap | NavigationMap) -> Array:
    """(rows, cols) bool: cells with any value, or with any reason but UNOBSERVED."""
    if isinstance(grid, NavigationMap):
        return np.asarray((grid.cells != Cell.UNKNOWN) | (grid.reason != CellReason.UNOBSERVED))
    known = np.zeros(grid.shape, bool)
    for name, layer in grid.layers.items():
        known |= layer != 0 if name in COUNTS else ~np.isnan(layer)
    return known


def ahead(grid: _Map) -> _Map:
    """A map without the columns farther than `METRES_BEHIND` behind its origin, if nothing is known of them.

    A map that lies farther behind stays whole.
    """
    columns = max(0, round((-METRES_BEHIND - grid.origin[0]) / grid.resolution))
    known = grid.cells != Cell.UNKNOWN if isinstance(grid, NavigationMap) else np.isfinite(grid.layers["elevation"])
    whole = columns >= known.shape[1] or known[:, :columns].any()
    found: _Map = grid if whole else _part(grid, slice(0, None), slice(columns, None))
    return found


def _grid_of(item: ElevationMap | NavigationMap) -> Grid:
    shape = item.shape if isinstance(item, ElevationMap) else item.cells.shape
    return item.frame_id, item.origin, item.resolution, shape


def _rim(grid: Grid) -> int:
    """Cells to keep around the known ones."""
    frame_id, _, resolution, _ = grid
    return 0 if frame_id == LEVEL_FRAME else math.ceil(RIM_WIDTH / resolution)


def _window(known: Array, rim: int) -> Span:
    """Rows and columns of the known cells and a rim around them; all if none is known."""
    return spanned(known, rim) if known.any() else (slice(0, known.shape[0]), slice(0, known.shape[1]))


def _part(item: ElevationMap | NavigationMap, rows: slice, cols: slice) -> Any:
    """The cells of a map in a window."""
    (x, y), step = item.origin, item.resolution
    origin = x + cols.start * step, y + rows.start * step
    if isinstance(item, NavigationMap):
        return replace(item, cells=item.cells[rows, cols], reason=item.reason[rows, cols], origin=origin)
    return replace(item, layers={name: layer[rows, cols] for name, layer in item.layers.items()}, origin=origin)
