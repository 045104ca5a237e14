"""Images at half size, and disparity images at double size: interpolated within a surface, nearest at its edge."""

from __future__ import annotations

import cv2
import numpy as np

from stages.compiled.jit import inlined_part, kernel
from stages.data import Array

F32 = np.float32
MAX_STEP = 1.0  # px of the small image, between the pixels of one surface


def halved(image: Array) -> Array:
    """An image at half size, each pixel the mean of four; an odd last row or column is repeated."""
    height, width = image.shape[:2]
    if height % 2 or width % 2:
        image = cv2.copyMakeBorder(image, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
    half: Array = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return half


@kernel
def doubled(small, height, width):
    """A disparity image at double size with doubled values, (height, width) float32, px, NaN = unknown.

    small: (H, W) float32, of half the size, rounded up.
    """
    large = np.empty((height, width), np.float32)
    rows, columns = small.shape
    last = columns - 1
    for y in range(height):
        row, beside = small[y >> 1], small[min(max((y >> 1) + (y & 1) * 2 - 1, 0), rows - 1)]
        target = large[y]
        for col in range(np.uint64(1), np.uint64(max(last, 1))):  # without sign: numba looks for no negative index
            target[col + col] = _between(row, beside, col, col - np.uint64(1))
            target[col + col + np.uint64(1)] = _between(row, beside, col, col + np.uint64(1))
        target[0] = _between(row, beside, 0, 0)
        if width > 1:
            target[1] = _between(row, beside, 0, min(1, last))
            target[2 * last] = _between(row, beside, last, max(last - 1, 0))
            if 2 * last + 1 < width:
                target[2 * last + 1] = _between(row, beside, last, last)
    return large


@inlined_part
def _between(row, beside, col, next_col):
    """Twice the disparity a quarter of the way from a pixel to its neighbours, as pixel centres are whole numbers."""
    nearest = row[col]
    along = F32(0.75) * nearest + F32(0.25) * row[next_col]
    smooth = F32(0.75) * along + F32(0.25) * (F32(0.75) * beside[col] + F32(0.25) * beside[next_col])
    return F32(2) * (smooth if abs(smooth - nearest) < F32(MAX_STEP) else nearest)


def doubled_reference(small: Array, height: int, width: int) -> Array:
    """`doubled`, in plain numpy."""
    y, x = np.mgrid[:height, :width]
    row, col = y // 2, x // 2
    beside = np.clip(row + np.where(y % 2, 1, -1), 0, small.shape[0] - 1)
    next_col = np.clip(col + np.where(x % 2, 1, -1), 0, small.shape[1] - 1)
    nearest = small[row, col]
    along = F32(0.75) * nearest + F32(0.25) * small[row, next_col]
    other = F32(0.75) * small[beside, col] + F32(0.25) * small[beside, next_col]
    smooth = F32(0.75) * along + F32(0.25) * other
    with np.errstate(invalid="ignore"):
        large: Array = F32(2) * np.where(np.abs(smooth - nearest) < F32(MAX_STEP), smooth, nearest)
    return large
