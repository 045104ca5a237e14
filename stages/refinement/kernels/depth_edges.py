"""Moves depth edges onto image edges by a weighted median (Ma et al., 2013).

A match at the edge of a rock is often one pixel off, or between rock and ground, where there is nothing. The median of
a window, weighted by similarity to the pixel in the middle, is a disparity of the side that the pixel belongs to. A
pixel stays if two fifths of the weight are on its own side of the jump. Only pixels next to a jump are handled, with
every other pixel of their windows, as on a chessboard. The median is found by bisection: each step is one sum of whole
numbers over the window, exact in any order.
"""

from __future__ import annotations

import cv2
import numpy as np

from stages.compiled.jit import fast_part, kernel, part
from stages.compiled.parallel import by_bands, shared_by
from stages.data import Array

F32 = np.float32
STEPS_PER_PX = 16  # steps per pixel, resolution of the median
MAX_WEIGHT = 1000  # weight of a pixel of equal brightness
MIN_OWN_SHARE = F32(0.4)  # share of the weight on a pixel's own side; with less it changes sides
LANES = 32


def sharpen_edges(
    disparity: Array, guessed: Array, guide: Array, radius: int, jump: float, brightness: float, threads: int = 1
) -> Array:
    """Each disparity beside a jump becomes its window's weighted median, unless enough weight is on its own side.

    disparity: (H, W) float32, px, NaN = unknown; guessed: (H, W) bool, guesses, which do not move matches; guide:
    (H, W) uint8; radius: of the window, px; jump: px between neighbours; brightness: gray levels over which a weight
    falls to 1/e. Returns (H, W) float32.
    """
    sharp = np.empty_like(disparity)
    border = radius, radius, radius, radius, cv2.BORDER_CONSTANT
    padded = cv2.copyMakeBorder(disparity, *border, value=np.nan)
    doubt = cv2.copyMakeBorder(guessed.view(np.uint8), *border, value=0)
    given = padded, doubt, cv2.copyMakeBorder(guide, *border, value=0), _taps(radius) @ [padded.shape[1], 1], radius
    rule = F32(jump), _weights(brightness)
    by_bands(shared_by(threads), len(disparity), lambda first, end: _sharpen(*given, *rule, sharp, first, end))
    return sharp


def _taps(radius: int) -> Array:
    """Offsets of every other pixel of a window from its middle: rows and columns, (n, 2)."""
    taps = np.indices((2 * radius + 1,) * 2).reshape(2, -1).T - radius
    return np.asarray(taps[taps.sum(axis=1) % 2 == 0])


def _weights(brightness: float) -> Array:
    """Weight by difference of brightness, (256,) float32, whole numbers."""
    return np.round(MAX_WEIGHT * np.exp(-np.arange(256) / brightness)).astype(np.float32)


@kernel
def _sharpen(disparity, guessed, guide, taps, radius, jump, table, sharp, first, end):
    """Sharpen rows first to end; inputs are padded by `radius` pixels, taps are offsets in memory."""
    width, stride = sharp.shape[1], disparity.shape[1]
    flat, doubt, levels = disparity.reshape(-1), guessed.reshape(-1), guide.reshape(-1)
    size = (taps.size + LANES - 1) // LANES * LANES  # whole vectors; the surplus has no weight
    values, weights = np.zeros(size, np.float32), np.zeros(size, np.float32)
    jumps = np.empty(width, np.bool_)
    for y in range(first, end):
        sharp[y] = disparity[y + radius, radius : radius + width]
        _find_jumps(disparity, y + radius, radius, jump, jumps)
        for x in range(width):
            if jumps[x]:
                at = np.uint64((y + radius) * stride + x + radius)
                near, low, high = _compare(flat, doubt, levels, taps, table, at, jump, values, weights)
                total = _weight_up_to(values, weights, high)
                if near < MIN_OWN_SHARE * total:
                    sharp[y, x] = _median(values, weights, total, low, high) / F32(STEPS_PER_PX)


@part
def _find_jumps(disparity, y, column, jump, jumps):
    """Mark the pixels of row y, from `column`, with a jump to one of their eight neighbours."""
    above, row, below = disparity[y - 1, column - 1 :], disparity[y, column - 1 :], disparity[y + 1, column - 1 :]
    for x in range(jumps.size):
        d = row[x + 1]
        up = (abs(above[x] - d) > jump) | (abs(above[x + 1] - d) > jump) | (abs(above[x + 2] - d) > jump)
        down = (abs(below[x] - d) > jump) | (abs(below[x + 1] - d) > jump) | (abs(below[x + 2] - d) > jump)
        jumps[x] = up | down | (abs(row[x] - d) > jump) | (abs(row[x + 2] - d) > jump)


@part
def _compare(flat, doubt, levels, taps, table, at, jump, values, weights):
    """Disparities at the taps, in steps of 1 / STEPS_PER_PX px, and their weights, 0 = does not count.

    Returns the weight of those within `jump` of the middle pixel, and the smallest and largest.
    """
    near, low, high = F32(0), F32(np.inf), F32(-np.inf)
    for i in range(taps.size):
        place = np.uint64(np.int64(at) + taps[i])
        value, step = flat[place], np.int32(levels[place]) - np.int32(levels[at])
        known = value == value and doubt[place] <= doubt[at]
        fine = np.floor(value * F32(STEPS_PER_PX) + F32(0.5))
        values[i], weights[i] = (fine, table[abs(step)]) if known else (F32(0), F32(0))
        near += weights[i] if abs(value - flat[at]) <= jump else F32(0)
        if known:
            low, high = min(low, fine), max(high, fine)
    return near, low, high


@fast_part
def _median(values, weights, total, low, high):
    """The weighted median, between low and high."""
    below = low - F32(1)
    while high - below > F32(1):
        half = np.floor(F32(0.5) * (below + high))
        enough = F32(2) * _weight_up_to(values, weights, half) >= total
        below, high = below if enough else half, half if enough else high
    return high


@fast_part
def _weight_up_to(values, weights, limit):
    total = F32(0)
    for i in range(values.size):
        total += weights[i] if values[i] <= limit else F32(0)
    return total


def sharpen_edges_reference(
    disparity: Array, guessed: Array, guide: Array, radius: int, jump: float, brightness: float
) -> Array:
    """`sharpen_edges` in plain numpy, pixel by pixel."""
    height, width = disparity.shape
    table, taps, sharp = _weights(brightness), _taps(radius), disparity.copy()
    for y, x in np.argwhere(np.isfinite(disparity)):
        near = disparity[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
        if not np.nanmax(np.abs(near - disparity[y, x])) > np.float32(jump):
            continue
        rows, cols = (taps + np.array([y, x])).T
        inside = (rows >= 0) & (rows < height) & (cols >= 0) & (cols < width)
        rows, cols = rows[inside], cols[inside]
        known = np.isfinite(disparity[rows, cols]) & (guessed[rows, cols] <= guessed[y, x])
        values = np.floor(disparity[rows, cols][known] * STEPS_PER_PX + 0.5)
        weights = table[np.abs(guide[rows, cols].astype(int) - int(guide[y, x]))][known]
        near = np.abs(disparity[rows, cols][known] - disparity[y, x]) <= np.float32(jump)
        if weights[near].sum() >= MIN_OWN_SHARE * weights.sum():
            continue
        order = np.argsort(values, kind="stable")
        sharp[y, x] = values[order][np.argmax(2 * np.cumsum(weights[order]) >= weights.sum())] / STEPS_PER_PX
    return sharp
