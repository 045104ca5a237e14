"""How far the evidence of a disparity image reaches, and which unknown pixels are within it.

What lies above all that is known in a column is the sky, and what lies beyond the known ends of a row was not seen by
both cameras: there a guess may reach a little farther, not more. Specks do not count: the sky is full of them.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from stages.compiled.jit import kernel
from stages.compiled.parallel import by_bands, shared_by, with_margin
from stages.data import Array

SIDE = 15  # px, of the square around a pixel that separates evidence from a speck
SHARE = 0.5  # of what such a square knows in the mean; what stands in one that knows less is a speck


class Extent(NamedTuple):
    """How far the evidence reaches, of a disparity image (H, W). Where there is none, first > last, top = H."""

    top: Array  # (W,) int64, the uppermost row in which a column is known
    first: Array  # (H,) int64, the first column in which a row is known
    last: Array  # (H,) int64, the last one


def extent(disparity: Array, threads: int = 1) -> Extent:
    """How far what is known reaches, but for specks.

    disparity: (H, W) float32, NaN = unknown; threads: 2 share the work, to the same result.
    """
    height, width = disparity.shape
    known, evidence = ~np.isnan(disparity), np.empty(disparity.shape, bool)
    least = int(SHARE * SIDE**2 * (np.count_nonzero(known) / known.size))
    found = Extent(np.full(width, height, np.int64), np.full(height, 2 * width, np.int64), np.full(height, -width))

    def weed(first: int, end: int) -> None:
        about, own = with_margin(known.view(np.uint8), first, end, SIDE // 2)
        around = cv2.boxFilter(about, cv2.CV_16U, (SIDE, SIDE), normalize=False, borderType=cv2.BORDER_REPLICATE)
        np.logical_and(known[first:end], around[own] > least, out=evidence[first:end])
        _find_ends(evidence[first:end], found.first[first:end], found.last[first:end])

    by_bands(shared_by(threads), height, weed)
    _find_top(evidence, found.top)
    return found


@kernel
def _find_top(known, top):
    missing = top.size
    for y in range(known.shape[0]):
        if missing == 0:
            break
        for x in range(top.size):
            if known[y, x] and y < top[x]:
                top[x] = y
                missing -= 1


@kernel
def _find_ends(known, first, last):
    width = known.shape[1]
    for y in range(known.shape[0]):
        row = known[y]
        x = 0
        while x < width and not row[x]:
            x += 1
        if x == width:
            continue
        first[y] = x
        x = width - 1
        while not row[x]:
            x -= 1
        last[y] = x


def extent_reference(disparity: Array) -> Extent:
    """`extent` in plain numpy."""
    known = np.isfinite(disparity)
    height, width = known.shape
    around = sliding_window_view(np.pad(known, SIDE // 2, mode="edge"), (SIDE, SIDE)).sum(axis=(2, 3))
    known &= around > np.floor(SHARE * SIDE**2 * known.mean())
    rows, columns = known.any(axis=1), known.any(axis=0)
    last = width - 1 - known[:, ::-1].argmax(axis=1)
    return Extent(
        np.where(columns, known.argmax(axis=0), height), np.where(rows, known.argmax(axis=1), 2 * width),
        np.where(rows, last, -width),
    )  # fmt: skip
