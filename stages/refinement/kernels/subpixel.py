"""Matches to a fraction of a pixel, from brightness (Lucas and Kanade, 1981).

Where neighbours have the same whole disparity, as on a surface that faces the camera, semi-global matching makes both
steps away from it dearer, and so draws the fraction to 0, by up to a quarter of a pixel. Brightness knows of no whole
pixels: a match is moved by the shift d that makes the left window most like the right one, up to a constant,

    d = -sum (g - mean g) (e - mean e) / sum ((g - mean g)^2 + NOISE^2)    with e(p) = L(p) - R(p - disparity(p))

and g the mean of both images' gradients along the row; in between, the right image is a Catmull-Rom spline. The window
is what of the square about a pixel has about its disparity, so that no edge of depth is in it, and of that every other
pixel, as on a chessboard. Where there is little contrast, or little of a window, the match stays about where it was.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel, part
from stages.compiled.parallel import by_bands, shared_by
from stages.data import Array

F32 = np.float32
ALIKE = F32(1.5)  # px, by which disparities in a window differ at most
LEAST = F32(1 / 3)  # of the square's pixels that count, which a window must have
NOISE = F32(4)  # gray levels, of a contrast that carries little information
FARTHEST = F32(0.3)  # px, that a match is moved
LANES = 64  # pixels of a row that are worked on at once


def fit_brightness(left: Array, right: Array, disparity: Array, radius: int, threads: int = 1) -> Array:
    """The disparities moved to where both images are most alike, (H, W) float32.

    left, right: (H, W) uint8; disparity: (H, W) float32, px, NaN = unknown; radius: of the square, px; threads: 2 share
    the work, to the same result.
    """
    both, (height, width) = shared_by(threads), disparity.shape
    framed = np.empty((3, height, -(-width // LANES) * LANES + 2 * radius), F32)  # disparity, error, gradient
    moved = np.empty(disparity.shape, F32)
    by_bands(both, height, lambda first, end: _compare(left, right, disparity, radius, framed, first, end))
    by_bands(both, height, lambda first, end: _move(framed, disparity, radius, moved, first, end))
    return moved


@kernel
def _compare(left, right, disparity, radius, framed, first, end):
    """Of rows first to end the disparity, what the right image differs by, and the mean gradient; NaN where there is no
    partner, and `radius` columns and more about the image."""
    width = disparity.shape[1]
    framed[:, first:end] = np.nan
    for y in range(first, end):
        for x in range(1, width - 1):
            at = F32(x) - disparity[y, x]
            if F32(1) <= at < F32(width - 2):
                i = np.int64(at)
                t = at - F32(i)
                a, b, c, d = F32(right[y, i - 1]), F32(right[y, i]), F32(right[y, i + 1]), F32(right[y, i + 2])
                one, two, three = c - a, F32(2) * a - F32(5) * b + F32(4) * c - d, F32(3) * (b - c) + d - a
                value = b + F32(0.5) * t * (one + t * (two + t * three))
                slope = F32(0.5) * (one + t * (F32(2) * two + F32(3) * t * three))
                framed[0, y, x + radius] = disparity[y, x]
                framed[1, y, x + radius] = F32(left[y, x]) - value
                framed[2, y, x + radius] = F32(0.5) * (slope + F32(0.5) * (F32(left[y, x + 1]) - F32(left[y, x - 1])))


@kernel
def _move(framed, disparity, radius, moved, first, end):
    """Rows first to end of disparities, each moved by what its window says."""
    height, width = disparity.shape
    sums = np.empty(5 * LANES, np.float32)
    least = LEAST * F32((2 * radius + 1) ** 2 // 2)
    for y in range(first, end):
        for start in range(0, width, LANES):
            sums[:] = 0
            own = framed[0, y, start + radius : start + radius + LANES]
            for v in range(max(y - radius, 0), min(y + radius + 1, height)):
                for at in range(start + ((v - y + radius) & 1), start + 2 * radius + 1, 2):
                    there = slice(at, at + LANES)
                    _add(own, framed[0, v, there], framed[1, v, there], framed[2, v, there], sums)
            for j in range(min(LANES, width - start)):
                x = start + j
                count, g, e = sums[j], sums[LANES + j], sums[2 * LANES + j]
                moved[y, x] = disparity[y, x]
                if count >= least:
                    contrast = sums[3 * LANES + j] - g * g / count + count * NOISE * NOISE
                    step = (sums[4 * LANES + j] - g * e / count) / contrast
                    moved[y, x] -= min(max(step, -FARTHEST), FARTHEST)


@part
def _add(own, disparity, error, gradient, sums):
    """Add a pixel of each of `LANES` windows to its sums, if it belongs there: of 1, g, e, g g, g e.

    They stand in one array, with constant distances: so the compiler knows that they do not overlap, and adds vectors.
    """
    for j in range(LANES):
        inside = abs(disparity[j] - own[j]) <= ALIKE
        g, e = gradient[j] if inside else F32(0), error[j] if inside else F32(0)
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
            inside = (abs(disparity[window] - disparity[y, x]) <= ALIKE) & np.isfinite(error[window])
        inside &= chessboard[window] == chessboard[y, x]
        if np.count_nonzero(inside) >= LEAST * ((2 * radius + 1) ** 2 // 2):
            g, e = (layer[window][inside] - layer[window][inside].mean() for layer in (gradient, error))
            step = (g @ e) / (g @ g + len(g) * float(NOISE) ** 2)
            moved[y, x] -= np.clip(step, -FARTHEST, FARTHEST)
    return moved
