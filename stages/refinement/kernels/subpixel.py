"""Subpixel refinement of matches from brightness (Lucas and Kanade, 1981).

Semi-global matching penalises both steps away from the neighbours' whole disparity, as on a surface that faces the
camera. So it pulls fractions of a pixel towards 0, by up to a quarter of a pixel. Brightness has no such bias. A match
moves by the shift d that makes the left window most similar to the right one, up to a constant,

    d = -sum (g - mean g) (e - mean e) / sum ((g - mean g)^2 + IMAGE_NOISE^2)    with e(p) = L(p) - R(p - disparity(p))

where g is the mean of both images' gradients along the row. A Catmull-Rom spline interpolates the right image. The
window contains the pixels of similar disparity, so that no depth edge is in it, and of those every other one, as on a
chessboard. With little contrast or few pixels in the window, the match hardly moves.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import inlined_part, kernel
from stages.compiled.parallel import by_bands, shared_by
from stages.data import Array

F32 = np.float32
MAX_WINDOW_STEP = F32(1.5)  # px between disparities of a window
MIN_WINDOW_SHARE = F32(1 / 3)  # of the pixels on the chessboard
IMAGE_NOISE = F32(4)  # gray levels, standard deviation of the images
MAX_SHIFT = F32(0.3)  # px
LANES = 64  # pixels of a row handled together


def fit_brightness(left: Array, right: Array, disparity: Array, radius: int, threads: int = 1) -> Array:
    """Disparities moved to where both images are most similar, (H, W) float32.

    left, right: (H, W) uint8; disparity: (H, W) float32, px, NaN = unknown; radius: of the window, px.
    """
    both, (height, width) = shared_by(threads), disparity.shape
    framed = np.empty((3, height, -(-width // LANES) * LANES + 2 * radius), F32)  # disparity, error, gradient
    moved = np.empty(disparity.shape, F32)
    by_bands(both, height, lambda first, end: _compare(left, right, disparity, radius, framed, first, end))
    by_bands(both, height, lambda first, end: _move(framed, disparity, radius, moved, first, end))
    return moved


@kernel
def _compare(left, right, disparity, radius, framed, first, end):
    """Disparity, difference of the images and mean gradient of rows first to end.

    NaN without a partner, and in a frame of `radius` columns. The partners of a row are read first: so the compiler
    vectorises the rest.
    """
    width = disparity.shape[1]
    paired, shares = np.zeros(width, np.bool_), np.zeros(width, np.float32)
    taps = np.zeros((4, width), np.uint8)  # of the spline in the right image
    framed[:, first:end] = np.nan
    for y in range(first, end):
        there, levels, partners = disparity[y], left[y], right[y]
        for x in range(1, width - 1):
            at = F32(x) - there[x]
            paired[x] = F32(1) <= at < F32(width - 2)
            if paired[x]:
                before = np.int32(at)
                shares[x] = at - F32(before)
                for k in range(4):
                    taps[k, x] = partners[np.uint64(before + k - 1)]
        own, error, gradient = framed[0, y, radius:], framed[1, y, radius:], framed[2, y, radius:]
        for x in range(1, width - 1):
            a, b, c, d = F32(taps[0, x]), F32(taps[1, x]), F32(taps[2, x]), F32(taps[3, x])
            one, two, three = c - a, F32(2) * a - F32(5) * b + F32(4) * c - d, F32(3) * (b - c) + d - a
            t = shares[x]
            value = b + F32(0.5) * t * (one + t * (two + t * three))
            slope = F32(0.5) * (one + t * (F32(2) * two + F32(3) * t * three))
            slope = F32(0.5) * (slope + F32(0.5) * (F32(levels[x + 1]) - F32(levels[x - 1])))
            own[x] = there[x] if paired[x] else F32(np.nan)
            error[x] = F32(levels[x]) - value if paired[x] else F32(np.nan)
            gradient[x] = slope if paired[x] else F32(np.nan)


@kernel
def _move(framed, disparity, radius, moved, first, end):
    """Move the disparities of rows first to end."""
    height, width = disparity.shape
    sums = np.empty(5 * LANES, np.float32)
    least = MIN_WINDOW_SHARE * F32((2 * radius + 1) ** 2 // 2)
    for y in range(first, end):
        for start in range(0, width, LANES):
            sums[:] = 0
            own = framed[0, y, start + radius : start + radius + LANES]
            for v in range(max(y - radius, 0), min(y + radius + 1, height)):
                for at in range(start + ((v - y + radius) & 1), start + 2 * radius + 1, 2):
                    there = slice(at, at + LANES)
                    _add(own, framed[0, v, there], framed[1, v, there], framed[2, v, there], sums)
            before, after = disparity[y, start : start + LANES], moved[y, start : start + LANES]
            for x in range(before.size):
                count, g, e = sums[x], sums[LANES + x], sums[2 * LANES + x]
                contrast = sums[3 * LANES + x] - g * g / count + count * IMAGE_NOISE * IMAGE_NOISE
                step = (sums[4 * LANES + x] - g * e / count) / contrast
                after[x] = before[x] - min(max(step, -MAX_SHIFT), MAX_SHIFT) if count >= least else before[x]


@inlined_part
def _add(own, disparity, error, gradient, sums):
    """Add one pixel of each of `LANES` windows to its sums of 1, g, e, g g, g e, if its disparity is similar.

    All sums are in one array at constant distances: so the compiler knows that they do not overlap and vectorises.
    """
    for j in range(LANES):
        g, e, inside = gradient[j], error[j], abs(disparity[j] - own[j]) <= MAX_WINDOW_STEP
        g, e = g if inside else F32(0), e if inside else F32(0)
        sums[j] += F32(1) if inside else F32(0)
        sums[LANES + j] += g
        sums[2 * LANES + j] += e
        sums[3 * LANES + j] += g * g
        sums[4 * LANES + j] += g * e


def fit_brightness_reference(left: Array, right: Array, disparity: Array, radius: int) -> Array:
    """`fit_brightness` in plain numpy, pixel by pixel, in double precision."""
    width = disparity.shape[1]
    error, gradient, moved = np.full(disparity.shape, np.nan), np.full(disparity.shape, np.nan), disparity.copy()
    for y, x in np.argwhere(np.isfinite(disparity)):
        at = x - float(disparity[y, x])
        if 1 <= at < width - 2 and 0 < x < width - 1:
            i, t = int(at), at - int(at)
            taps = right[y, i - 1 : i + 3].astype(float)
            spline = np.array([[0, 2, 0, 0], [-1, 0, 1, 0], [2, -5, 4, -1], [-1, 3, -3, 1]]) @ taps / 2
            error[y, x] = left[y, x] - spline @ t ** np.arange(4)
            slope = spline[1:] @ (np.array([1, 2, 3]) * t ** np.arange(3))
            gradient[y, x] = (slope + (float(left[y, x + 1]) - float(left[y, x - 1])) / 2) / 2
    chessboard = np.indices(disparity.shape).sum(axis=0) % 2
    for y, x in np.argwhere(np.isfinite(error)):
        window = tuple(slice(max(0, place - radius), place + radius + 1) for place in (y, x))
        with np.errstate(invalid="ignore"):
            inside = (abs(disparity[window] - disparity[y, x]) <= MAX_WINDOW_STEP) & np.isfinite(error[window])
        inside &= chessboard[window] == chessboard[y, x]
        if np.count_nonzero(inside) >= MIN_WINDOW_SHARE * ((2 * radius + 1) ** 2 // 2):
            g, e = (layer[window][inside] - layer[window][inside].mean() for layer in (gradient, error))
            step = (g @ e) / (g @ g + len(g) * float(IMAGE_NOISE) ** 2)
            moved[y, x] -= np.clip(step, -MAX_SHIFT, MAX_SHIFT)
    return moved
