"""Pages of a difference: what A and B have, and B less A with a scale."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from recordings.comparison.measures import GridLayers, on_one_grid, verdicts_on_one_grid
from recordings.export.page_layout import Page, add_bar, add_legend, map_page, page_of
from recordings.export.png_pages import disparity_page, elevation_page, navigation_page
from recordings.png import png
from recordings.ros2.from_msg import read_disparity, read_grid_map, read_layers, read_occupancy_grid
from recordings.sinks import colormaps
from stages.data import Array, Cell

DISPARITY_LIMIT = 1.0  # px at the ends of the scale
HEIGHT_LIMIT = 0.05  # m
_GRID_MAP = "grid_map_msgs/msg/GridMap"
_LESS, _NONE, _MORE = (33, 102, 172), (247, 247, 247), (178, 24, 43)
_SHADES = 128  # of blue, and of red
_COLORS = np.concatenate([np.linspace(_LESS, _NONE, _SHADES + 1), np.linspace(_NONE, _MORE, _SHADES + 1)[1:]])
ONLY_ONE = {1: ("only in A", (120, 90, 160)), 2: ("not in A", (70, 150, 110))}
FLIPS = {
    0: ("same", (225, 225, 222)),
    1: ("now free", (60, 170, 90)),
    2: ("now a hazard", (216, 62, 48)),
    3: ("now unknown", (90, 90, 96)),
}


def pages(schema: str, one: Any, other: Any) -> tuple[Page, Page, Page] | None:
    """A, B, and B less A as pages with one extent and one scale; None for two sizes, for maps far apart, or a map
    without elevations.

    schema: full ROS 2 name, in `PAGES`, of the type of the decoded messages.
    """
    if schema == _GRID_MAP and "elevation" not in read_layers(one):
        return None
    return PAGES[schema](one, other)


def error_page(estimate: Array, truth: Array) -> bytes | None:
    """Disparities less the true ones, (H, W), px, as a page in a PNG file; None for images of two sizes."""
    if estimate.shape != truth.shape:
        return None
    page = page_of(_change_colors(truth, estimate, DISPARITY_LIMIT), "error of the disparity, px")
    others = {1: ("not found", ONLY_ONE[1][1]), 2: ("no truth", ONLY_ONE[2][1])}
    add_bar(page, -DISPARITY_LIMIT, DISPARITY_LIMIT, lambda values: signed_colors(values, DISPARITY_LIMIT), others)
    return png(page.pixels)


def signed_colors(change: Array, limit: float) -> Array:
    """Changes, any shape (..., ), as RGB: blue is less, red is more; NaN is `colormaps.UNKNOWN_RGB`."""
    known = np.nan_to_num(change * (_SHADES / limit))
    rgb = _COLORS.astype(np.uint8).take(np.rint(np.clip(known, -_SHADES, _SHADES)).astype(np.intp) + _SHADES, axis=0)
    rgb[np.isnan(change)] = colormaps.UNKNOWN_RGB
    return rgb


def _disparities(one: Any, other: Any) -> tuple[Page, Page, Page] | None:
    first, second = read_disparity(one), read_disparity(other)
    if first.shape != second.shape:
        return None
    limit = max(map(colormaps.disparity_limit, (first, second)))
    page = page_of(_change_colors(first, second, DISPARITY_LIMIT), "change from A, px")
    add_bar(page, -DISPARITY_LIMIT, DISPARITY_LIMIT, lambda values: signed_colors(values, DISPARITY_LIMIT), ONLY_ONE)
    return disparity_page(first, limit), disparity_page(second, limit), page


def _elevations(one: Any, other: Any) -> tuple[Page, Page, Page] | None:
    maps = [read_grid_map(message) for message in (one, other)]
    grids = on_one_grid(*(GridLayers(item.layers, item.origin, item.resolution) for item in maps))
    if grids is None:
        return None
    first, second = (replace(item, **grid._asdict()) for item, grid in zip(maps, grids, strict=True))
    heights = [grid.layers["elevation"] for grid in grids]
    limits = colormaps.elevation_limits(np.concatenate([layer.ravel() for layer in heights]))
    page = map_page(_change_colors(heights[0], heights[1], HEIGHT_LIMIT), first, "change from A, m")
    add_bar(page, -HEIGHT_LIMIT, HEIGHT_LIMIT, lambda values: signed_colors(values, HEIGHT_LIMIT), ONLY_ONE)
    return elevation_page(first, limits), elevation_page(second, limits), page


def _verdicts(one: Any, other: Any) -> tuple[Page, Page, Page] | None:
    grids = verdicts_on_one_grid(read_occupancy_grid(one), read_occupancy_grid(other))
    if grids is None:
        return None
    first, second = grids
    before, after = first.cells, second.cells
    codes = np.select([before == after, after == Cell.FREE, after == Cell.HAZARD], [0, 1, 2], 3)
    page = map_page(colormaps.legend_colors(codes, FLIPS), first, "change from A")
    add_legend(page, FLIPS)
    return navigation_page(first), navigation_page(second), page


def _change_colors(one: Array, other: Array, limit: float) -> Array:
    """Other less one in colours; values that only one has are drawn in colours of their own."""
    rgb = signed_colors(other - one, limit)
    for code, known in ((1, np.isfinite(one) & np.isnan(other)), (2, np.isnan(one) & np.isfinite(other))):
        rgb[known] = ONLY_ONE[code][1]
    return rgb


PAGES: Mapping[str, Callable[[Any, Any], tuple[Page, Page, Page] | None]] = {
    "stereo_msgs/msg/DisparityImage": _disparities,
    _GRID_MAP: _elevations,
    "nav_msgs/msg/OccupancyGrid": _verdicts,
}
