"""How much two messages of one topic differ, in the terms of their type."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from recordings.ros2.from_msg import read_disparity, read_layers, read_occupancy_grid
from stages.data import Array, Cell, NavigationMap

Measures = dict[str, float]
Layers = Mapping[str, Array]
_CELLS = {Cell.UNKNOWN: "unknown", Cell.FREE: "free", Cell.HAZARD: "hazard"}


class _Grid(NamedTuple):
    """Where a grid lies: (x, y) of its lower-left corner and the size of its cells, m."""

    origin: tuple[float, float]
    resolution: float


def measures(schema: str, one: Any, other: Any) -> Measures:
    """What differs between two decoded messages of one topic and stamp: name with unit -> number, such as
    {"pixels": 120, "largest px": 0.5}. A larger number is a larger difference. Empty where only bytes without a measure
    differ. schema: full ROS 2 name of the type.
    """
    measure = _MEASURES.get(schema)
    return {} if measure is None else {name: value for name, value in measure(one, other).items() if value}


def side_by_side(one: Layers, other: Layers, grids: Sequence[Any]) -> dict[str, tuple[Array, Array]]:
    """The layers that two grids of one resolution share, each on the smallest grid that contains both.

    grids: the two grids (`origin`, `resolution`), whose layers `one` and `other` are. Cells outside are NaN.
    """
    first = [tuple(round(value / grid.resolution) for value in grid.origin[::-1]) for grid in grids]
    shapes = [next(iter(layers.values())).shape for layers in (one, other)]
    low = np.min(first, axis=0)
    high = np.max([np.add(start, shape) for start, shape in zip(first, shapes, strict=True)], axis=0)

    def placed(layer: Array, start: tuple[int, ...]) -> Array:
        whole = np.full(high - low, np.nan, np.float32)
        row, col = np.subtract(start, low)
        whole[row : row + layer.shape[0], col : col + layer.shape[1]] = layer
        return whole

    names = [name for name in one if name in other]
    return {name: (placed(one[name], first[0]), placed(other[name], first[1])) for name in names}


def cells(one: NavigationMap, other: NavigationMap) -> tuple[Array, Array]:
    """The cells of two maps on one grid, codes of `Cell`."""
    first, second = ({"cells": grid.cells.astype(np.float32)} for grid in (one, other))
    found = side_by_side(first, second, (one, other))["cells"]
    return tuple(np.where(np.isnan(part), Cell.UNKNOWN, part).astype(np.int8) for part in found)  # type: ignore[return-value]


def _disparities(one: Any, other: Any) -> Measures:
    found = _changes(read_disparity(one), read_disparity(other), "pixels", "px", 1.0)
    return found | {
        "largest difference of the baselines mm": 1e3 * float(np.nan_to_num(abs(other.t - one.t))),
        "largest difference of the focal lengths px": float(np.nan_to_num(abs(other.f - one.f))),
    }


def _maps(one: Any, other: Any) -> Measures:
    grids = [_grid_of(message) for message in (one, other)]
    if grids[0].resolution != grids[1].resolution:
        return {"maps of other resolution": 1.0}
    layers = side_by_side(read_layers(one), read_layers(other), grids)
    heights = layers.pop("elevation", None)
    found = {} if heights is None else _changes(*heights, "cells", "cm", 100.0)
    return found | {f"cells of layer {name}": float(np.sum(_differ(*pair))) for name, pair in layers.items()}


def _grid_of(message: Any) -> _Grid:
    info, centre = message.info, message.info.pose.position
    return _Grid((centre.x - info.length_x / 2, centre.y - info.length_y / 2), float(info.resolution))


def _verdicts(one: Any, other: Any) -> Measures:
    grids = read_occupancy_grid(one), read_occupancy_grid(other)
    if grids[0].resolution != grids[1].resolution:
        return {"maps of other resolution": 1.0}
    first, second = cells(*grids)
    return {
        f"cells from {name} to {_CELLS[after]}": float(np.sum((first == before) & (second == after)))
        for before, name in _CELLS.items()
        for after in _CELLS
        if before != after
    }


def _codes(one: Any, other: Any) -> Measures:
    first, second = (np.frombuffer(bytes(message.data), np.uint8) for message in (one, other))
    return {"pixels": float(np.sum(first != second)) if first.shape == second.shape else float(first.size)}


def _poses(one: Any, other: Any) -> Measures:
    first, second = one.pose.pose, other.pose.pose
    return _moved((first.position, first.orientation), (second.position, second.orientation))


def _transforms(one: Any, other: Any) -> Measures:
    first, second = (
        {(item.header.frame_id, item.child_frame_id): item.transform for item in message.transforms}
        for message in (one, other)
    )
    found = {f"transforms only in {name}": float(len(own.keys() - them.keys()))
             for name, own, them in (("A", first, second), ("B", second, first))}  # fmt: skip
    for frames in first.keys() & second.keys():
        moved = _moved(*((each.translation, each.rotation) for each in (first[frames], second[frames])))
        found |= {name: max(value, found.get(name, 0.0)) for name, value in moved.items()}
    return found


def _moved(one: tuple[Any, Any], other: tuple[Any, Any]) -> Measures:
    """How far apart two places are, each a position and a quaternion."""
    places = [np.array([at.x, at.y, at.z]) for at, _ in (one, other)]
    turn, to = (np.array([q.x, q.y, q.z, q.w]) for _, q in (one, other))
    near, far = sorted([np.linalg.norm(turn - to), np.linalg.norm(turn + to)])  # q and -q are the same turn
    distance = float(np.linalg.norm(places[1] - places[0]))
    return {"largest position mm": 1e3 * distance, "largest angle deg": float(np.degrees(4 * np.arctan2(near, far)))}


def _points(one: Any, other: Any) -> Measures:
    return {"points more or fewer": float(abs(one.width * one.height - other.width * other.height))}


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
    "sensor_msgs/msg/Image": _codes,
    "nav_msgs/msg/Odometry": _poses,
    "sensor_msgs/msg/PointCloud2": _points,
    "tf2_msgs/msg/TFMessage": _transforms,
}
