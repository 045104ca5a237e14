"""The layout of a page: a picture or a map with title, coordinates, colour bar or legend."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType

import cv2
import numpy as np

from recordings.sinks import colormaps
from stages.data import LEVEL_FRAME, Array, ElevationMap, NavigationMap

MAX_MAP_PX = 900  # maps are enlarged by a whole factor up to that
MARGIN_PX = 64  # around a picture, for its scales
INK, PAPER = (38, 40, 46), (250, 250, 248)
_MAX_OFFSET = 1e-3  # of a cell, by rounding
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def page_of(picture: Array, title: str) -> Array:
    """The picture (H, W, 3) with a margin, and room at the right for a colour bar or legend."""
    height, width = picture.shape[:2]
    page = np.full((height + 2 * MARGIN_PX, width + 4 * MARGIN_PX, 3), PAPER, np.uint8)
    page[MARGIN_PX : MARGIN_PX + height, MARGIN_PX : MARGIN_PX + width] = picture
    _text(page, title, (MARGIN_PX, MARGIN_PX - 20), 0.8)
    return page


def with_rover(
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


def map_page(rgb: Array, resolution: float, origin: tuple[float, float], title: str) -> Array:
    """A grid (rows, cols, 3) as a bird's-eye view, with x at its left and y below it at every second metre."""
    rows, cols = rgb.shape[:2]
    zoom = max(1, MAX_MAP_PX // max(rows, cols))
    page = page_of(colormaps.birds_eye(rgb).repeat(zoom, 0).repeat(zoom, 1), title)
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


def add_bar(
    page: Array, low: float, high: float, colors: Callable[[Array], Array],
    others: Mapping[int, tuple[str, colormaps.Rgb]] = MappingProxyType({}),
) -> None:  # fmt: skip
    """Draw a vertical colour bar with five values, and below it the colours of unknown and of others."""
    height, width = page.shape[0] - 2 * MARGIN_PX, page.shape[1]
    left, top, length = width - 2 * MARGIN_PX - 32, MARGIN_PX, height * 3 // 4
    ramp = colors(np.linspace(high, low, length))
    page[top : top + length, left : left + 28] = ramp[:, None]
    for share in np.linspace(0.0, 1.0, 5):
        value = high + share * (low - high)
        _text(page, colormaps.format_value(value), (left + 36, round(top + share * (length - 1)) + 6))
    for place, (name, rgb) in enumerate((("unknown", colormaps.UNKNOWN_RGB), *others.values())):
        _swatch(page, (left, top + length + 20 + 36 * place), name, rgb)


def add_legend(page: Array, legend: Mapping[int, tuple[str, colormaps.Rgb]]) -> None:
    """Draw the names and colours of codes at the right."""
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
