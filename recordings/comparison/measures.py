"""How much two messages of one topic differ, in the terms of their type."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from recordings.ros2.from_msg import read_disparity, read_layers, read_occupancy_grid, read_point_cloud
from recordings.ros2.plain import array_of
from stages.data import Array, Cell, NavigationMap

Measures = dict[str, float]
MAX_CELLS = 1 << 22  # of the grid that contains two maps
_APART = "cells of another place"
_CELLS = {Cell.UNKNOWN: "unknown", Cell.FREE: "free", Cell.HAZARD: "hazard"}


class GridLayers(NamedTuple):
    """Layers, (rows, cols) each; (x, y) of their grid's lower-left corner, m; the size of its cells, m."""

    layers: Mapping[str, Array]
    origin: tuple[float, float]
    resolution: float


def measures(schema: str, one: Any, other: Any) -> Measures:
    """What differs between two decoded messages of one topic and stamp: name with unit -> number, such as
    {"pixels": 120, "largest px": 0.5}. A larger number is a larger difference. Empty where only bytes without a measure
    differ. schema: full ROS 2 name of the type.
    """
    measure = _MEASURES.get(schema)
    return {} if measure is None else {name: value for name, value in measure(one, other).items() if value}


def on_one_grid(one: GridLayers, other: GridLayers) -> tuple[GridLayers, GridLayers] | None:
    """The layers that two grids share, float32, on the smallest grid that contains both, with the smaller cells.

    Cells outside are NaN. None where one grid is far from the other: if the common one would have more than `MAX_CELLS`
    and four times as many as both.
    """
    step = min(one.resolution, other.resolution)
    low = np.minimum(one.origin, other.origin)
    high = np.maximum(*(np.add(grid.origin, np.multiply(_shape(grid)[::-1], grid.resolution)) for grid in (one, other)))
    extents = [np.multiply(_shape(grid), grid.resolution / step).prod() for grid in (one, other)]
    if ((high - low) / step).prod() > max(MAX_CELLS, 4 * sum(extents)):
        return None
    columns, rows = (np.arange(round(length)) for length in (high - low) / step)

    def placed(grid: GridLayers) -> GridLayers:
        places = [
            np.floor((start + (cells + 0.5) * step - origin) / grid.resolution).astype(int)
            for start, cells, origin in zip(low[::-1], (rows, columns), grid.origin[::-1], strict=True)
        ]
        inside = [(place >= 0) & (place < size) for place, size in zip(places, _shape(grid), strict=True)]
        layers = {}
        for name in (name for name in one.layers if name in other.layers):
            layers[name] = np.full((rows.size, columns.size), np.nan, np.float32)
            known = np.ix_(*(place[within] for place, within in zip(places, inside, strict=True)))
            layers[name][np.ix_(*inside)] = grid.layers[name][known]
        return GridLayers(layers, (float(low[0]), float(low[1])), step)

    return placed(one), placed(other)


def _shape(grid: GridLayers) -> tuple[int, ...]:
    return next(iter(grid.layers.values())).shape


def verdicts_on_one_grid(one: NavigationMap, other: NavigationMap) -> tuple[NavigationMap, NavigationMap] | None:
    """Two maps on the grid of `on_one_grid`, without reasons."""
    grids = [
        GridLayers({"cells": grid.cells.astype(np.float32)}, grid.origin, grid.resolution) for grid in (one, other)
    ]

    def placed(grid: NavigationMap, on: GridLayers) -> NavigationMap:
        cells = np.where(np.isnan(on.layers["cells"]), Cell.UNKNOWN, on.layers["cells"]).astype(np.int8)
        reason = np.zeros(cells.shape, np.uint8)
        return replace(grid, cells=cells, reason=reason, origin=on.origin, resolution=on.resolution)

    if (found := on_one_grid(*grids)) is None:
        return None
    first, second = found
    return placed(one, first), placed(other, second)


def _disparities(one: Any, other: Any) -> Measures:
    found = _changes(read_disparity(one), read_disparity(other), "pixels", "px", 1.0)
    return found | {
        "largest difference of the baselines mm": 1e3 * float(np.nan_to_num(abs(other.t - one.t))),
        "largest difference of the focal lengths px": float(np.nan_to_num(abs(other.f - one.f))),
    }


def _maps(one: Any, other: Any) -> Measures:
    if (grids := on_one_grid(_grid_of(one), _grid_of(other))) is None:
        return {_APART: float(one.data[0].data.size)}
    first, second = (grid.layers for grid in grids)
    found = _changes(first["elevation"], second["elevation"], "cells", "cm", 100.0) if "elevation" in first else {}
    others = (name for name in first if name != "elevation")
    return found | {f"cells of layer {name}": float(np.sum(_differ(first[name], second[name]))) for name in others}


def _grid_of(message: Any) -> GridLayers:
    info, centre = message.info, message.info.pose.position
    origin = (centre.x - info.length_x / 2, centre.y - info.length_y / 2)
    return GridLayers(read_layers(message), origin, float(info.resolution))


def _verdicts(one: Any, other: Any) -> Measures:
    if (grids := verdicts_on_one_grid(read_occupancy_grid(one), read_occupancy_grid(other))) is None:
        return {_APART: float(one.data.size)}
    first, second = (grid.cells for grid in grids)
    return {
        f"cells from {name} to {_CELLS[after]}": float(np.sum((first == before) & (second == after)))
        for before, name in _CELLS.items()
        for after in _CELLS
        if before != after
    }


def _images(one: Any, other: Any) -> Measures:
    first, second = array_of(one), array_of(other)
    if first.shape != second.shape:
        return {"pixels of another size": float(one.height * one.width)}
    changed = _differ(first, second)
    return {"pixels": float(np.sum(changed.any(axis=2) if changed.ndim == 3 else changed))}


def _poses(one: Any, other: Any) -> Measures:
    at, to = (np.array([place.x, place.y, place.z]) for place in (one.pose.pose.position, other.pose.pose.position))
    turn, back = (np.array([q.x, q.y, q.z, q.w]) for q in (one.pose.pose.orientation, other.pose.pose.orientation))
    near, far = sorted([np.linalg.norm(turn - back), np.linalg.norm(turn + back)])  # q and -q are the same turn
    distance = float(np.linalg.norm(to - at))
    return {"largest position mm": 1e3 * distance, "largest angle deg": float(np.degrees(4 * np.arctan2(near, far)))}


def _points(one: Any, other: Any) -> Measures:
    """The distances from each point to the nearest one of the other cloud: a log keeps no pairs of points."""
    found = {"points more or fewer": float(abs(one.width * one.height - other.width * other.height))}
    first, second = map(_places, (one, other))
    if not (len(first) and len(second)):
        return found
    apart = np.concatenate([KDTree(second).query(first)[0], KDTree(first).query(second)[0]])
    sizes = {"median": 100 * np.median(apart), "largest": 100 * np.max(apart)}
    return found | {f"{name} distance to the nearest point cm": float(size) for name, size in sizes.items()}


def _places(message: Any) -> Array:
    """The finite points of a cloud, (N, 3) float64, m."""
    fields = read_point_cloud(message)
    points = np.column_stack([fields[axis] for axis in "xyz"]).astype(np.float64)
    return points[np.isfinite(points).all(axis=1)]


def _differ(one: Array, other: Array) -> Array:
    return np.asarray((one != other) & ~(np.isnan(one) & np.isnan(other)))


def _changes(one: Array, other: Array, what: str, unit: str, scale: float) -> Measures:
    """The differences of two arrays in which NaN is unknown."""
    if one.shape != other.shape:
        return {f"{what} of another size": float(one.size)}
    both = np.isfinite(one) & np.isfinite(other)
    change = scale * np.abs(one[both] - other[both])
    moved = change[change > 0]
    return {
        what: float(moved.size),
        f"{what} known only in A": float(np.sum(np.isfinite(one) & ~both)),
        f"{what} known only in B": float(np.sum(np.isfinite(other) & ~both)),
        f"median {unit}": float(np.median(moved)) if moved.size else 0.0,
        f"largest {unit}": float(np.max(moved)) if moved.size else 0.0,
    }


_MEASURES: Mapping[str, Callable[[Any, Any], Measures]] = {
    "stereo_msgs/msg/DisparityImage": _disparities,
    "grid_map_msgs/msg/GridMap": _maps,
    "nav_msgs/msg/OccupancyGrid": _verdicts,
    "sensor_msgs/msg/Image": _images,
    "nav_msgs/msg/Odometry": _poses,
    "sensor_msgs/msg/PointCloud2": _points,
}
