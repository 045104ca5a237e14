"""The layout of a page: a picture or a map with title, coordinates, colour bar or legend."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import cv2
import numpy as np

from recordings.sinks import colormaps
from stages.data import LEVEL_FRAME, Array, ElevationMap, NavigationMap

MAX_MAP_PX = 900  # maps are enlarged by a whole factor up to that
PART_PX = 140  # of a picture's width, per MARGIN_STEP of the margin around it, so that letters grow with the picture
MARGIN_STEP, MIN_STEPS = 16, 4  # px
INK, PAPER = (38, 40, 46), (250, 250, 248)
_MAX_OFFSET = 1e-3  # of a cell, by rounding
_FONT = cv2.FONT_HERSHEY_SIMPLEX


class Page(NamedTuple):
    """A picture with room around it.

    pixels: (H, W, 3); margin: px at the left of the picture, above and below; it is three times that at the right.
    """

    pixels: Array
    margin: int


def page_of(picture: Array, title: str, beside: int = 3) -> Page:
    """The picture (H, W, 3) with a margin, and room at the right for a colour bar or legend.

    beside: as many pages beside each other have legible letters in a window 1600 px wide.
    """
    height, width = picture.shape[:2]
    margin = MARGIN_STEP * max(MIN_STEPS, math.ceil(width * beside / (3 * PART_PX)))
    page = Page(np.full((height + 2 * margin, width + 4 * margin, 3), PAPER, np.uint8), margin)
    page.pixels[margin : margin + height, margin : margin + width] = picture
    _text(page, title, (margin, margin * 11 // 16), 0.0125 * margin)
    return page


def _with_rover(rgb: Array, grid: ElevationMap | NavigationMap) -> tuple[Array, tuple[float, float]]:
    """Cells (rows, cols, 3) in frame `level`, extended by unknown ones to the rover at (0, 0); and their origin."""
    if grid.frame_id != LEVEL_FRAME:
        return rgb, grid.origin
    (x, y), step = grid.origin, grid.resolution
    first = [min(0, math.floor(-at / step + _MAX_OFFSET)) for at in (y, x)]
    last = [max(size, math.ceil(-at / step - _MAX_OFFSET)) for at, size in zip((y, x), rgb.shape[:2], strict=True)]
    extended = np.full((last[0] - first[0], last[1] - first[1], 3), colormaps.UNKNOWN_RGB, np.uint8)
    extended[-first[0] :, -first[1] :][: rgb.shape[0], : rgb.shape[1]] = rgb
    return extended, (round(x + first[1] * step, 6), round(y + first[0] * step, 6))


def map_page(rgb: Array, grid: ElevationMap | NavigationMap, title: str) -> Page:
    """Cells (rows, cols, 3) of a map as a bird's-eye view, with x at its left and y below it at every second metre."""
    rgb, origin = _with_rover(rgb, grid)
    resolution, (rows, cols) = grid.resolution, rgb.shape[:2]
    zoom = max(1, MAX_MAP_PX // max(rows, cols))
    page = page_of(colormaps.birds_eye(rgb).repeat(zoom, 0).repeat(zoom, 1), f"{title} ({grid.frame_id})")
    margin = page.margin
    bottom, right, unit = margin + cols * zoom, margin + rows * zoom, margin / 64
    for x in _ticks(origin[0], cols * resolution):
        row = round(bottom - (x - origin[0]) / resolution * zoom)
        cv2.line(page.pixels, (round(margin - 8 * unit), row), (margin, row), INK, round(2 * unit))
        _text(page, f"{x:g}", (round(margin - 46 * unit), round(row + 6 * unit)))
    for y in _ticks(origin[1], rows * resolution):
        col = round(right - (y - origin[1]) / resolution * zoom)
        cv2.line(page.pixels, (col, bottom), (col, round(bottom + 8 * unit)), INK, round(2 * unit))
        _text(page, f"{y:g}", (round(col - 12 * unit), round(bottom + 30 * unit)))
    _text(page, "x forward, m", (round(right + 32 * unit), round(bottom + 8 * unit)))
    _text(page, "y left, m", (round(right + 32 * unit), round(bottom + 30 * unit)))
    if origin[0] <= 0.0 <= origin[0] + cols * resolution and origin[1] <= 0.0 <= origin[1] + rows * resolution:
        centre = (round(right + origin[1] / resolution * zoom), round(bottom + origin[0] / resolution * zoom))
        cv2.drawMarker(page.pixels, centre, (230, 60, 200), cv2.MARKER_TRIANGLE_UP, 16, 3)
    return page


def _ticks(start: float, length: float) -> Array:
    return 2.0 * np.arange(np.ceil(start / 2.0), np.floor((start + length) / 2.0) + 1) + 0.0  # no minus zero


def round_step(longest: float) -> float:
    """The longest step of an axis with round ticks: 1, 2 or 5 times a power of ten, at most `longest`."""
    power = 10.0 ** math.floor(math.log10(longest))
    return max(step for step in (power, 2 * power, 5 * power) if step <= longest * (1 + 1e-9))


def add_bar(
    page: Page, low: float, high: float, colors: Callable[[Array], Array],
    others: Mapping[int, tuple[str, colormaps.Rgb]] = MappingProxyType({}),
) -> None:  # fmt: skip
    """Draw a vertical colour bar with five values, and below it the colours of unknown and of others."""
    margin, left = page.margin, _legend_left(page)
    height, unit, wide = page.pixels.shape[0] - 2 * margin, margin / 64, margin * 7 // 16
    length = min(height * 3 // 4, max(height // 2, height - round((30 + 36 * (1 + len(others))) * unit)))
    ramp = colors(np.linspace(high, low, length))
    page.pixels[margin : margin + length, left : left + wide] = ramp[:, None]
    for share in np.linspace(0.0, 1.0, 5):
        place = round(left + 36 * unit), round(margin + share * (length - 1) + 6 * unit)
        _text(page, colormaps.format_value(high + share * (low - high)), place)
    for number, (name, rgb) in enumerate((("unknown", colormaps.UNKNOWN_RGB), *others.values())):
        _swatch(page, round(margin + length + (20 + 36 * number) * unit), name, rgb)


def add_legend(page: Page, legend: Mapping[int, tuple[str, colormaps.Rgb]]) -> None:
    """Draw the names and colours of codes at the right."""
    for number, (name, rgb) in enumerate(legend.values()):
        _swatch(page, page.margin + 11 * page.margin // 16 * number, name, rgb)


def _legend_left(page: Page) -> int:
    return int(page.pixels.shape[1]) - page.margin * 5 // 2


def _swatch(page: Page, top: int, name: str, rgb: colormaps.Rgb) -> None:
    left, unit = _legend_left(page), page.margin / 64
    right, bottom = left + round(27 * unit), top + round(27 * unit)
    cv2.rectangle(page.pixels, (left, top), (right, bottom), rgb, cv2.FILLED)
    cv2.rectangle(page.pixels, (left, top), (right, bottom), INK, round(unit))
    _text(page, name, (round(left + 36 * unit), round(top + 20 * unit)))


def _text(page: Page, text: str, at: tuple[int, int], size: float = 0.0) -> None:
    """A line of text. size: of the font; 0: that of the page, smaller where its room at the right is too narrow."""
    size = size or 0.6 * page.margin / 64
    width = cv2.getTextSize(text, _FONT, size, 1)[0][0]
    size *= min(1.0, (page.pixels.shape[1] - at[0]) / max(1, width))
    cv2.putText(page.pixels, text, at, _FONT, size, INK, max(1, round(1.6 * size)), cv2.LINE_AA)
