"""Pages of a difference: what A and B have, and B less A with a scale."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from recordings.comparison.measures import cells, elevations
from recordings.export.page_layout import add_bar, add_legend, map_page, page_of, with_rover
from recordings.export.png_pages import disparity_page, elevation_page, navigation_page
from recordings.ros2.from_msg import read_disparity, read_grid_map, read_layers, read_occupancy_grid
from recordings.sinks import colormaps
from stages.data import Array, Cell, ElevationMap, NavigationMap

DISPARITY_LIMIT = 1.0  # px at the ends of the scale
HEIGHT_LIMIT = 0.05  # m
_GRID_MAP = "grid_map_msgs/msg/GridMap"
_LESS, _NONE, _MORE = np.array([[33, 102, 172], [247, 247, 247], [178, 24, 43]], np.float32)
ONLY_ONE = {1: ("only in A", (120, 90, 160)), 2: ("only in B", (70, 150, 110))}
FLIPS = {
    0: ("same", (225, 225, 222)),
    1: ("now free", (60, 170, 90)),
    2: ("now a hazard", (216, 62, 48)),
    3: ("now unknown", (90, 90, 96)),
}


def pages(schema: str, one: Any, other: Any) -> tuple[Array, Array, Array] | None:
    """A, B, and B less A as RGB pages; None for a type without pages.

    Parameters
    ----------
    schema : str
        Full ROS 2 name of the type.
    one, other : message
        Two decoded messages.
    """
    if schema not in _PAGES or (schema == _GRID_MAP and "elevation" not in read_layers(one)):
        return None
    return _PAGES[schema](one, other)


def signed_colors(change: Array, limit: float) -> Array:
    """Changes, any shape (..., ), as RGB: blue is less, red is more; NaN is `colormaps.UNKNOWN_RGB`."""
    share = np.clip(np.nan_to_num(change) / limit, -1.0, 1.0)[..., None]
    rgb = _NONE + np.where(share < 0, -share * (_LESS - _NONE), share * (_MORE - _NONE))
    rgb[np.isnan(change)] = colormaps.UNKNOWN_RGB
    return np.asarray(rgb + 0.5, np.uint8)


def _disparities(one: Any, other: Any) -> tuple[Array, Array, Array]:
    first, second = read_disparity(one), read_disparity(other)
    page = page_of(_change_colors(first, second, DISPARITY_LIMIT), "B less A, px")
    add_bar(page, -DISPARITY_LIMIT, DISPARITY_LIMIT, lambda values: signed_colors(values, DISPARITY_LIMIT), ONLY_ONE)
    return disparity_page(first), disparity_page(second), page


def _elevations(one: Any, other: Any) -> tuple[Array, Array, Array]:
    first, second = read_grid_map(one), read_grid_map(other)
    page = _map(_change_colors(*elevations(first, second), HEIGHT_LIMIT), first, second, "B less A, m")
    add_bar(page, -HEIGHT_LIMIT, HEIGHT_LIMIT, lambda values: signed_colors(values, HEIGHT_LIMIT), ONLY_ONE)
    return elevation_page(first), elevation_page(second), page


def _verdicts(one: Any, other: Any) -> tuple[Array, Array, Array]:
    first, second = read_occupancy_grid(one), read_occupancy_grid(other)
    before, after = cells(first, second)
    codes = np.select([before == after, after == Cell.FREE, after == Cell.HAZARD], [0, 1, 2], 3)
    page = _map(colormaps.legend_colors(codes, FLIPS), first, second, "verdicts, B against A")
    add_legend(page, FLIPS)
    return navigation_page(first), navigation_page(second), page


def _change_colors(one: Array, other: Array, limit: float) -> Array:
    """Other less one in colours; values that only one has are drawn in colours of their own."""
    rgb = signed_colors(other - one, limit)
    for code, known in ((1, np.isfinite(one) & np.isnan(other)), (2, np.isnan(one) & np.isfinite(other))):
        rgb[known] = ONLY_ONE[code][1]
    return rgb


def _map(rgb: Array, one: ElevationMap | NavigationMap, other: ElevationMap | NavigationMap, title: str) -> Array:
    """A page of the grid that contains both."""
    origin = (min(one.origin[0], other.origin[0]), min(one.origin[1], other.origin[1]))
    nothing = np.zeros(rgb.shape[:2], np.uint8)
    whole = NavigationMap(one.stamp, nothing.view(np.int8), nothing, one.resolution, origin, one.frame_id)
    extended, corner = with_rover(rgb, whole, colormaps.UNKNOWN_RGB)
    return map_page(extended, one.resolution, corner, f"{title} ({one.frame_id})")


_PAGES: Mapping[str, Callable[[Any, Any], tuple[Array, Array, Array]]] = {
    "stereo_msgs/msg/DisparityImage": _disparities,
    _GRID_MAP: _elevations,
    "nav_msgs/msg/OccupancyGrid": _verdicts,
}
