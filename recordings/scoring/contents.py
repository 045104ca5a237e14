"""The contents of result and truth messages that a score compares."""

from __future__ import annotations

from typing import Any

import numpy as np

from recordings.ros2 import from_msg as ros2
from recordings.scoring.metrics import aligned
from stages.data import Array, Cell, ElevationMap, NavigationMap
from stages.data.rotations import matrix_of

SCORED_LAYERS = {"elevation", "variance", "common_variance", "interpolated"}
CAMERA_RTOL = 1e-3  # of focal length and baseline; cameras that differ by less are the same


def mask_of(frame: dict[str, Any], topic: str, shape: tuple[int, ...]) -> Array | None:
    """The pixels of a mono8 image of the truth; None if the frame has none. Raises ValueError for another shape."""
    if (image := frame.get(topic)) is None:
        return None
    if (image.height, image.width) != shape:
        raise ValueError(f"{topic} is {image.width}x{image.height}, /truth/disparity is {shape[1]}x{shape[0]}")
    return np.asarray(image.data).reshape(image.height, image.step)[:, : image.width]


def layers_of(message: Any, onto: ElevationMap) -> dict[str, Array]:
    """The scored layers of a GridMap, on the cells of `onto`. Raises ValueError if it does not fit."""
    grid = ros2.read_grid_map(message)
    wanted = sorted(grid.layers.keys() & SCORED_LAYERS)
    return {name: _fitted(grid, grid.layers[name], onto, np.nan) for name in wanted}


def cells_of(message: Any, onto: ElevationMap) -> Array:
    """The cells of an OccupancyGrid, on the cells of `onto`. Raises ValueError if it does not fit."""
    grid = ros2.read_occupancy_grid(message)
    return _fitted(grid, grid.cells, onto, Cell.UNKNOWN)


def _fitted(grid: ElevationMap | NavigationMap, values: Array, onto: ElevationMap, missing: float) -> Array:
    if abs(grid.resolution - onto.resolution) > 1e-4 * onto.resolution:
        cells = f"its cells are {grid.resolution:g} m wide, the truth's {onto.resolution:g} m"
        raise ValueError(f"{cells}; run with that resolution")
    if grid.frame_id != onto.frame_id:
        raise ValueError(f"it is in frame '{grid.frame_id}', the truth in '{onto.frame_id}'")
    return aligned(values, grid.origin, onto.shape, onto.origin, onto.resolution, missing)


def place_of(vector: Any) -> Array:
    """A geometry_msgs/Vector3 or Point, m, as an array (3,)."""
    return np.array([vector.x, vector.y, vector.z])


def same_camera(one: Any, other: Any) -> bool:
    """Whether two DisparityImages have the same focal length and baseline, where both state them."""
    ours, theirs = (one.f, one.t), (other.f, other.t)
    stated = min(*ours, *theirs) > 0  # neither NaN nor 0
    return not stated or np.allclose(ours, theirs, rtol=CAMERA_RTOL, atol=0)


def lens_of(disparity: Any) -> str:
    """The focal length and the baseline of a DisparityImage, in words."""
    return f"f = {disparity.f:.6g} px and a baseline of {disparity.t:.4g} m"


def rotation_of(quaternion: Any) -> Array:
    """A geometry_msgs/Quaternion as a rotation (3, 3)."""
    return matrix_of([quaternion.x, quaternion.y, quaternion.z, quaternion.w])


def rocks_of(message: Any) -> Array:
    """x, y, diameter and height, m, and pixels and shown if present, of /truth/rocks."""
    fields = ros2.read_point_cloud(message)
    names = ("x", "y", "diameter", "height", "pixels", "shown")
    return np.column_stack([fields[name] for name in names if name in fields])
