"""Shaded relief of a map in one pass, in colours of few shades, as a recording has it of every frame.

The plain reference are `elevation_colors` and `fewer_shades` of `recordings.sinks.colormaps`.
"""

from __future__ import annotations

import cv2
import numpy as np

from recordings.sinks import colormaps
from stages.compiled.jit import borrowing_kernel
from stages.data import Array, ElevationMap


def relief(terrain: ElevationMap, limits: tuple[float, float]) -> Array:
    """`elevation_colors`, (rows, cols, 3) uint8, with `fewer_shades` of the known cells. limits: of the colours, m."""
    elevation, (low, high) = np.ascontiguousarray(terrain.layers["elevation"]), limits
    rgb = np.empty((*elevation.shape, 3), np.uint8)
    scale = np.array([low, high - low, terrain.resolution], np.float32)
    table = colormaps.palette_table(cv2.COLORMAP_VIRIDIS)
    _paint(elevation, scale, np.array(colormaps.SUN), colormaps.AMBIENT_LIGHT, table, rgb)
    return rgb


@borrowing_kernel
def _paint(elevation: Array, scale: Array, sun: Array, ambient: float, table: Array, rgb: Array) -> None:
    """scale: lowest height, range of heights, and size of a cell; table: colours of 256 steps and of unknown."""
    flat = ambient + (1.0 - ambient) * sun[2]
    for row in range(elevation.shape[0]):
        for col in range(elevation.shape[1]):
            height = elevation[row, col]
            if not np.isfinite(height):
                for channel in range(3):
                    rgb[row, col, channel] = table[256, channel]
                continue
            share = min(max((height - scale[0]) / scale[1], np.float32(0)), np.float32(1))
            place = int(share * np.float32(255) + np.float32(0.5))
            slope_x = _mean_rise(elevation, row, col, 0, 1) / scale[2]
            slope_y = _mean_rise(elevation, row, col, 1, 0) / scale[2]
            normal = np.sqrt(slope_x * slope_x + slope_y * slope_y + np.float32(1))
            lit = min(max((sun[2] - sun[0] * slope_x - sun[1] * slope_y) / normal, 0.0), 1.0)
            shade = (ambient + (1.0 - ambient) * lit) / flat
            for channel in range(3):
                rgb[row, col, channel] = int(min(table[place, channel] * shade, 251.0)) + 4 & 0xF8


@borrowing_kernel
def _mean_rise(elevation: Array, row: int, col: int, down: int, right: int) -> np.float32:
    """The mean of the rises to the next and from the last cell along an axis, as far as these are known."""
    rise, sides = np.float32(0), 0
    for sign in (1, -1):
        i, j = row + sign * down, col + sign * right
        if 0 <= i < elevation.shape[0] and 0 <= j < elevation.shape[1]:
            step = elevation[i, j] - elevation[row, col] if sign > 0 else elevation[row, col] - elevation[i, j]
            if np.isfinite(step):
                rise, sides = rise + step, sides + 1
    return rise / np.float32(max(sides, 1))
