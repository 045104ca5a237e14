"""PNG pages of a result log: disparity, elevation and navigation map of a few frames, with scales and legends.

The pages show the messages of the log. Maps are bird's-eye views: x (forward) up, y (left) to the left, with the
coordinates of the map's frame at their edges.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from recordings.errors import LogError
from recordings.mcap.file import McapFile, iter_decoded
from recordings.ros2.from_msg import read_disparity, read_grid_map, read_occupancy_grid
from recordings.sinks import colormaps
from stages.data import LEVEL_FRAME, Array, Cell, ElevationMap, NavigationMap

MAX_MAP_PX = 900  # maps are enlarged by a whole factor up to that
MARGIN_PX = 64  # around a picture, for its scales
INK, PAPER = (38, 40, 46), (250, 250, 248)
_MAX_OFFSET = 1e-3  # of a cell, by rounding
_FONT = cv2.FONT_HERSHEY_SIMPLEX


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
            _write(path, page_of(message))
            written.append(path)
    return sorted(written)


def disparity_page(disparity: Array) -> Array:
    """Disparities (H, W), px, NaN = unknown, as an RGB page with a colour bar."""
    limit = colormaps.disparity_limit(disparity)
    page = _page(colormaps.disparity_colors(disparity, limit), "disparity, px")
    _bar(page, 0.0, limit, cv2.COLORMAP_TURBO)
    return page


def elevation_page(terrain: ElevationMap) -> Array:
    """Shaded relief of a terrain as an RGB page with coordinates and a colour bar."""
    terrain = colormaps.terrain_ahead(terrain)
    low, high = colormaps.elevation_limits(terrain.layers["elevation"])
    rgb, origin = _with_rover(colormaps.elevation_colors(terrain, (low, high)), terrain, colormaps.UNKNOWN_RGB)
    page = _map_page(rgb, terrain.resolution, origin, f"elevation, m ({terrain.frame_id})")
    _bar(page, low, high, cv2.COLORMAP_VIRIDIS)
    return page


def navigation_page(navigation: NavigationMap) -> Array:
    """A navigation map as an RGB page with coordinates and a legend."""
    navigation = colormaps.navigation_ahead(navigation)
    colors, unknown = (
        colormaps.legend_colors(navigation.cells, colormaps.CELL_LEGEND),
        colormaps.CELL_LEGEND[Cell.UNKNOWN],
    )
    rgb, origin = _with_rover(colors, navigation, unknown[1])
    page = _map_page(rgb, navigation.resolution, origin, f"navigation map ({navigation.frame_id})")
    _legend(page, colormaps.CELL_LEGEND)
    return page


PAGES: Mapping[str, tuple[str, Callable[[Any], Array]]] = {
    "/nav/disparity": ("disparity", lambda message: disparity_page(read_disparity(message))),
    "/nav/elevation_map": ("elevation", lambda message: elevation_page(read_grid_map(message))),
    "/nav/navigation_map": ("navigation", lambda message: navigation_page(read_occupancy_grid(message))),
}


def _page(picture: Array, title: str) -> Array:
    """The picture (H, W, 3) with a margin, and room at the right for a colour bar or legend."""
    height, width = picture.shape[:2]
    page = np.full((height + 2 * MARGIN_PX, width + 4 * MARGIN_PX, 3), PAPER, np.uint8)
    page[MARGIN_PX : MARGIN_PX + height, MARGIN_PX : MARGIN_PX + width] = picture
    _text(page, title, (MARGIN_PX, MARGIN_PX - 20), 0.8)
    return page


def _with_rover(
    rgb: Array, grid: ElevationMap | NavigationMap, unknown: tuple[int, int, int]
) -> tuple[Array, tuple[float, float]]:
    """A grid (rows, cols, 3) in frame `level`, extended by unknown cells to the rover at (0, 0); and its origin."""
    if grid.frame_id != LEVEL_FRAME:
        return rgb, grid.origin
    (x, y), step = grid.origin, grid.resolution
    first = [min(0, math.floor(-at / step + _MAX_OFFSET)) for at in (y, x)]
    last = [max(size, math.ceil(-at / step - _MAX_OFFSET)) for at, size in zip((y, x), rgb.shape[:2], strict=True)]
    extended = np.full((last[0] - first[0], last[1] - first[1], 3), unknown, np.uint8)
    extended[-first[0] :, -first[1] :][: rgb.shape[0], : rgb.shape[1]] = rgb
    return extended, (round(x + first[1] * step, 6), round(y + first[0] * step, 6))


def _map_page(rgb: Array, resolution: float, origin: tuple[float, float], title: str) -> Array:
    """A grid (rows, cols, 3) as a bird's-eye view, with x at its left and y below it at every second metre."""
    rows, cols = rgb.shape[:2]
    zoom = max(1, MAX_MAP_PX // max(rows, cols))
    page = _page(colormaps.birds_eye(rgb).repeat(zoom, 0).repeat(zoom, 1), title)
    bottom, right = MARGIN_PX + cols * zoom, MARGIN_PX + rows * zoom
    for x in _ticks(origin[0], cols * resolution):
        row = round(bottom - (x - origin[0]) / resolution * zoom)
        cv2.line(page, (MARGIN_PX - 8, row), (MARGIN_PX, row), INK, 2)
        _text(page, f"{x:g}", (MARGIN_PX - 46, row + 6))
    for y in _ticks(origin[1], rows * resolution):
        col = round(right - (y - origin[1]) / resolution * zoom)
        cv2.line(page, (col, bottom), (col, bottom + 8), INK, 2)
        _text(page, f"{y:g}", (col - 12, bottom + 30))
    _text(page, "x forward, m", (right + 32, bottom + 8))
    _text(page, "y left, m", (right + 32, bottom + 30))
    if origin[0] <= 0.0 <= origin[0] + cols * resolution and origin[1] <= 0.0 <= origin[1] + rows * resolution:
        centre = (round(right + origin[1] / resolution * zoom), round(bottom + origin[0] / resolution * zoom))
        cv2.drawMarker(page, centre, (230, 60, 200), cv2.MARKER_TRIANGLE_UP, 16, 3)
    return page


def _ticks(start: float, length: float) -> Array:
    return 2.0 * np.arange(np.ceil(start / 2.0), np.floor((start + length) / 2.0) + 1) + 0.0  # no minus zero


def _bar(page: Array, low: float, high: float, palette: int) -> None:
    """A vertical colour bar with five values, and the colour of unknown below it."""
    height, width = page.shape[0] - 2 * MARGIN_PX, page.shape[1]
    left, top, length = width - 2 * MARGIN_PX - 32, MARGIN_PX, height * 3 // 4
    ramp = colormaps.apply_palette(np.linspace(high, low, length), low, high, palette)
    page[top : top + length, left : left + 28] = ramp[:, None]
    for share in np.linspace(0.0, 1.0, 5):
        value = high + share * (low - high)
        _text(page, colormaps.format_value(value), (left + 36, round(top + share * (length - 1)) + 6))
    _swatch(page, (left, top + length + 20), "unknown", colormaps.UNKNOWN_RGB)


def _legend(page: Array, legend: Mapping[int, tuple[str, colormaps.Rgb]]) -> None:
    left = page.shape[1] - 2 * MARGIN_PX - 32
    for place, (name, rgb) in enumerate(legend.values()):
        _swatch(page, (left, MARGIN_PX + 44 * place), name, rgb)


def _swatch(page: Array, corner: tuple[int, int], name: str, rgb: colormaps.Rgb) -> None:
    x, y = corner
    cv2.rectangle(page, (x, y), (x + 27, y + 27), rgb, cv2.FILLED)
    cv2.rectangle(page, (x, y), (x + 27, y + 27), INK, 1)
    _text(page, name, (x + 36, y + 20))


def _text(page: Array, text: str, at: tuple[int, int], size: float = 0.6) -> None:
    cv2.putText(page, text, at, _FONT, size, INK, 1, cv2.LINE_AA)


def _write(path: Path, rgb: Array) -> None:
    _, blob = cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    path.write_bytes(blob.tobytes())
