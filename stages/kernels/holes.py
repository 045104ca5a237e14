"""Holes of a disparity image, row by row: what only one camera sees told apart from what was merely not matched.

A surface hidden from one camera lies behind the one that hides it. So where the two ends of a hole in a row lie on
surfaces apart, the hole takes the farther one, never the foreground; where they lie on one surface, the hole is a
mismatch and the line between its ends fills it. Both are guesses that reach only so far, and nothing is guessed above
all that is known in a column: that is the sky.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stages.data import Array
from stages.kernels.compiled import kernel
from stages.kernels.halves import pairs

APART = 2.0  # px of disparity between the ends of a hole that make them two surfaces
KEPT, MISMATCH, OCCLUSION, OPEN = range(4)  # kinds of pixels: not a hole, filled as either, not filled


class Extent(NamedTuple):
    """How far the evidence reaches, of a disparity image (H, W). Where there is none, first > last, top = H."""

    top: Array  # (W,) int64, the uppermost row in which a column is known
    first: Array  # (H,) int64, the first column in which a row is known
    last: Array  # (H,) int64, the last one


def extent(disparity: Array) -> Extent:
    """How far what is known reaches. disparity: (H, W) float32, NaN = unknown."""
    height, width = disparity.shape
    found = Extent(np.full(width, height, np.int64), np.full(height, 4 * width, np.int64), np.full(height, -4 * width))
    _find_top(disparity, found.top)
    _find_ends(disparity, found.first, found.last)
    return found


def fill_holes(
    disparity: Array, within: Extent, reach: float, margin: float, threads: int = 1
) -> tuple[Array, Array]:
    """Fill the holes that evidence explains.

    disparity: (H, W) float32, px, NaN = unknown; within: how far the evidence reaches; reach: px that a hole may be
    wider than the step between its ends; margin: px beyond the evidence that are filled, from the one end that a hole
    at the image's border has, and above. Returns the filled image, (H, W) float32, and the kind of each pixel, (H, W)
    uint8: `KEPT`, `MISMATCH`, `OCCLUSION` or `OPEN`.
    """
    height, width = disparity.shape
    filled, kinds = np.empty((height, width), np.float32), np.empty((height, width), np.uint8)
    given = float(reach), int(margin), within
    middle = height // 2
    with pairs(threads) as both:
        both(
            lambda: _fill(disparity, 0, middle, *given, filled, kinds),
            lambda: _fill(disparity, middle, height, *given, filled, kinds),
        )
    return filled, kinds


@kernel
def _find_top(disparity, top):  # type: ignore[no-untyped-def]
    missing = top.size
    for y in range(disparity.shape[0]):
        if missing == 0:
            break
        for x in range(top.size):
            d = disparity[y, x]
            if d == d and y < top[x]:
                top[x] = y
                missing -= 1


@kernel
def _find_ends(disparity, first, last):  # type: ignore[no-untyped-def]
    width = disparity.shape[1]
    for y in range(disparity.shape[0]):
        row = disparity[y]
        x = 0
        while x < width and row[x] != row[x]:
            x += 1
        if x == width:
            continue
        first[y] = x
        x = width - 1
        while row[x] != row[x]:
            x -= 1
        last[y] = x


@kernel
def _fill(disparity, start, end, reach, margin, within, filled, kinds):  # type: ignore[no-untyped-def]
    width = disparity.shape[1]
    for y in range(start, end):
        row, out, kind = disparity[y], filled[y], kinds[y]
        last = -1
        for x in range(width + 1):
            if x < width:
                d = row[x]
                if d != d:
                    continue
                out[x], kind[x] = d, KEPT
            _fill_hole(row, last, x, y, reach, margin, within, out, kind)
            last = x


@kernel
def _fill_hole(row, last, stop, y, reach, margin, within, out, kind):  # type: ignore[no-untyped-def]
    """The hole between the known pixels `last` and `stop`, either of which may be outside the row."""
    has_left, has_right = last >= 0, stop < row.size
    left = row[last] if has_left else np.float32(np.inf)
    right = row[stop] if has_right else np.float32(np.inf)
    both, step = has_left and has_right, abs(right - left)
    explained = stop - last - 1 <= reach + step if both else has_left or has_right
    level = both and step < APART
    slope = (right - left) / np.float32(stop - last) if level else np.float32(0)
    begin, end = within.first[y] - margin, within.last[y] + margin
    for x in range(last + 1, stop):
        if explained and y >= within.top[x] - margin and x >= begin and x <= end:
            out[x] = left + slope * np.float32(x - last) if level else min(left, right)
            kind[x] = MISMATCH if level else OCCLUSION
        else:
            out[x], kind[x] = np.float32(np.nan), OPEN


def fill_holes_reference(disparity: Array, within: Extent, reach: float, margin: float) -> tuple[Array, Array]:
    """`fill_holes` in plain numpy."""
    known = np.isfinite(disparity)
    height, width = disparity.shape
    column, row = np.arange(width), np.arange(height)[:, None]
    left = np.maximum.accumulate(np.where(known, column, -1), axis=1)
    right = np.flip(np.minimum.accumulate(np.flip(np.where(known, column, width), axis=1), axis=1), axis=1)
    padded = np.pad(disparity, ((0, 0), (1, 1)), constant_values=np.inf)
    before, after = np.take_along_axis(padded, left + 1, axis=1), np.take_along_axis(padded, right + 1, axis=1)
    both = (left >= 0) & (right < width)
    step = np.abs(np.where(both, after, 0) - np.where(both, before, 0))
    explained = np.where(both, right - left - 1 <= reach + step, (left >= 0) | (right < width))
    reached = (row >= within.top - margin) & (column >= within.first[:, None] - margin)
    reached &= column <= within.last[:, None] + margin
    level = both & (step < APART)
    with np.errstate(invalid="ignore"):
        line = before + (after - before) / (right - left) * (column - left)
    guess = np.where(level, line, np.minimum(before, after))
    fill = ~known & explained & reached
    kinds = np.where(known, KEPT, np.where(~fill, OPEN, np.where(level, MISMATCH, OCCLUSION)))
    return np.where(fill, guess, disparity).astype(np.float32), kinds.astype(np.uint8)
