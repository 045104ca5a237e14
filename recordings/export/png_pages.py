"""PNG pages of a result log: disparity, elevation and navigation map of a few frames, with scales and legends.

The pages show the messages of the log. Maps are bird's-eye views: x (forward) up, y (left) to the left, with the
coordinates of the map's frame at their edges.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from recordings.errors import LogError
from recordings.export.page_layout import Page, add_bar, add_legend, map_page, page_of
from recordings.mcap.file import McapFile, iter_decoded
from recordings.png import png
from recordings.ros2.from_msg import read_disparity, read_grid_map, read_occupancy_grid
from recordings.sinks import colormaps
from stages.data import Array, ElevationMap, NavigationMap


def draw(result: Path, out: Path) -> list[Path]:
    """Write `frame-NNNN-{disparity,elevation,navigation}.png` of the first, middle and last frame into `out`.

    Returns the files, sorted. Raises LogError if the log has nothing to draw.
    """
    with McapFile(result) as log:
        stamps = np.unique(log.times(log.channels_of(PAGES))).tolist()
    if not stamps:
        raise LogError(f"{result} contains none of {', '.join(PAGES)}; give a result log")
    chosen = {stamps[number]: number for number in (0, len(stamps) // 2, len(stamps) - 1)}
    out.mkdir(parents=True, exist_ok=True)
    written = []
    for topic, stamp, message in iter_decoded(result, PAGES):
        if stamp in chosen:
            name, page_of = PAGES[topic]
            path = out / f"frame-{chosen[stamp]:04d}-{name}.png"
            path.write_bytes(png(page_of(message).pixels))
            written.append(path)
    return sorted(written)


def disparity_page(disparity: Array, limit: float | None = None) -> Page:
    """Disparities (H, W), px, NaN = unknown, as an RGB page with a colour bar from 0 to a limit."""
    limit = colormaps.disparity_limit(disparity) if limit is None else limit
    page = page_of(colormaps.disparity_colors(disparity, limit), "disparity, px")
    add_bar(page, 0.0, limit, lambda values: colormaps.disparity_colors(values, limit))
    return page


def elevation_page(terrain: ElevationMap, limits: tuple[float, float] | None = None) -> Page:
    """Shaded relief of a terrain as an RGB page with coordinates and a colour bar over `limits`, m."""
    low, high = limits or colormaps.elevation_limits(terrain.layers["elevation"])
    page = map_page(colormaps.elevation_colors(terrain, (low, high)), terrain, "elevation, m")
    add_bar(page, low, high, lambda values: colormaps.apply_palette(values, low, high, cv2.COLORMAP_VIRIDIS))
    return page


def navigation_page(navigation: NavigationMap) -> Page:
    """A navigation map as an RGB page with coordinates and a legend."""
    colors = colormaps.legend_colors(navigation.cells, colormaps.CELL_LEGEND)
    page = map_page(colors, navigation, "navigation map")
    add_legend(page, colormaps.CELL_LEGEND)
    return page


PAGES: Mapping[str, tuple[str, Callable[[Any], Page]]] = {
    "/nav/disparity": ("disparity", lambda message: disparity_page(read_disparity(message))),
    "/nav/elevation_map": ("elevation", lambda message: elevation_page(read_grid_map(message))),
    "/nav/navigation_map": ("navigation", lambda message: navigation_page(read_occupancy_grid(message))),
}
