"""Rivals of a match: other disparities, a period away, at which the images are as alike.

The cost of a disparity is the squared difference of two windows less their rows' means. A rival is a low point of that
cost, and between it and the match the windows differ: where a row has no texture, all disparities are alike and none is
a rival. The windows are low, because the shift of a rival changes from row to row.
"""

from __future__ import annotations

from math import ceil, floor
from typing import NamedTuple

import numpy as np

from stages.compiled.jit import fast_kernel, fast_part
from stages.data import Array

F32 = np.float32
HALF_ROWS = 1  # rows of the window above and below its middle
MIN_DISTANCE = 3  # px, of a rival from the match
MIN_RISE = 0.5  # of the cost between the match and a rival, in units of what unlike textures cost
NONE = 1e30  # cost of a rival that does not exist


class Rivals(NamedTuple):
    """Of each sample, (N,) float32, in units of the variance of the noise.

    texture: sum of squares of the left window less its rows' means; found, rival: half the cost of the match and of its
    best rival, NONE without one. For windows that differ by noise alone, `found` is on average the number of their
    pixels less that of their rows. A texture of 0 means that the match's window is not in the right image.
    """

    texture: Array
    found: Array
    rival: Array


def find_rivals(
    images: tuple[Array, Array], pixels: Array, samples: Array, noise: Array, half_width: int, infinity: float,
    reach: int,
) -> Rivals:  # fmt: skip
    """The match and its best rival at some pixels.

    images: left and right, (H, W) uint8; pixels: (H, W) float32, disparities, px; samples: (N, 2) int64, row and column
    of pixels with a disparity; noise: (256,) float32, standard deviation at each gray level; half_width: half the width
    of the window, even, px; infinity: px, the disparity of infinitely far points; reach: px, the largest disparity that
    is searched, or, if that is more, half of it beyond the match.

    The windows of all samples must be in the left image.
    """
    found = np.zeros((3, len(samples)), np.float32)
    _find_rivals(*images, pixels, samples, noise, half_width, infinity, reach, found)
    return Rivals(*found)


@fast_kernel
def _find_rivals(left, right, pixels, samples, noise, half_width, infinity, reach, found):
    """Write texture, half the cost of the match and that of the rival, in units of the noise, to `found` (3, N)."""
    width = left.shape[1]
    window, strip = np.empty(2 * half_width, np.float32), np.empty(width, np.float32)
    costs = np.empty(width, np.float32)
    pixel_count = (2 * HALF_ROWS + 1) * (2 * half_width - 1)
    for k in range(samples.shape[0]):
        y, x = samples[k, 0], samples[k, 1]
        disparity = pixels[y, x]
        # The right windows begin at the columns `first` to `last`, all with the match's fraction of a pixel.
        column = floor(x - half_width - disparity)
        fraction = F32(x - half_width - disparity - column)
        first = max(0, ceil(x - half_width - max(float(reach), disparity + 0.5 * reach)))
        last = min(floor(x - half_width - infinity + 1), width - 2 * half_width - 1)
        if column < first or column > last:
            continue
        costs[: last - first + 1] = F32(0)
        texture, level = F32(0), F32(0)
        for row in range(y - HALF_ROWS, y + HALF_ROWS + 1):
            part, mean = _add_costs(left[row], right[row], x - half_width, first, last, fraction, window, strip, costs)
            texture, level = texture + part, level + mean
        variance = noise[int(level / F32(2 * HALF_ROWS + 1))] ** 2
        unlike = texture - F32(pixel_count) * variance
        match, rival = _best(costs, last - first + 1, column - first, unlike)
        found[0, k], found[1, k] = texture / variance, match / (2 * variance)
        found[2, k] = rival / (2 * variance) if rival < NONE else F32(NONE)


@fast_part
def _add_costs(left, right, begin, first, last, fraction, window, strip, costs):
    """Add the costs of one row to `costs`; return the squares of the left window and its mean.

    begin: first column of the left window; first, last: first columns of the first and the last right window; fraction:
    px, by which each right window is shifted.
    """
    length = window.shape[0]
    mean = F32(0)
    for j in range(length):
        mean += F32(left[begin + j])
    mean /= F32(length)
    squares = F32(0)
    for j in range(length):
        window[j] = F32(left[begin + j]) - mean
        squares += window[j] * window[j]
    for j in range(last - first + length):
        here, beside = F32(right[first + j]), F32(right[first + j + 1])
        strip[j] = here + fraction * (beside - here) - mean
    total, power = F32(0), F32(0)
    for j in range(length):
        total += strip[j]
        power += strip[j] * strip[j]
    for c in range(last - first + 1):
        costs[c] += squares + power - total * total / F32(length)
        if c < last - first:
            total += strip[c + length] - strip[c]
            power += strip[c + length] * strip[c + length] - strip[c] * strip[c]
    # Four pixels of the window at a time, for all disparities, read and write the costs a quarter as often.
    for j in range(0, length, 4):
        w0, w1, w2, w3 = F32(2) * window[j], F32(2) * window[j + 1], F32(2) * window[j + 2], F32(2) * window[j + 3]
        s0, s1, s2, s3 = strip[j:], strip[j + 1 :], strip[j + 2 :], strip[j + 3 :]
        for c in range(last - first + 1):
            costs[c] -= w0 * s0[c] + w1 * s1[c] + w2 * s2[c] + w3 * s3[c]
    return squares, mean


@fast_part
def _best(costs, count, found, unlike):
    """The cost of the match at index `found`, and of its best rival; unlike: half the cost of unlike texture."""
    place = found
    for c in range(max(found - 1, 0), min(found + 2, count)):
        if costs[c] < costs[place]:
            place = c
    match, rival = _low_point(costs, count, place), F32(NONE)
    for step in (-1, 1):
        c, risen = found, False
        while 0 <= c < count:
            if costs[c] - match >= F32(2 * MIN_RISE) * unlike:
                risen = True
            elif risen and abs(c - found) >= MIN_DISTANCE:
                rival = min(rival, _low_point(costs, count, c))
            c += step
    return match, rival


@fast_part
def _low_point(costs, count, c):
    """The lowest cost near index `c`: if it is a low point, that of the parabola through it and its neighbours."""
    if c == 0 or c == count - 1:
        return costs[c]
    before, after = costs[c - 1] - costs[c], costs[c + 1] - costs[c]
    if before < F32(0) or after < F32(0) or before + after <= F32(0):
        return costs[c]
    return costs[c] - (before - after) * (before - after) / (F32(8) * (before + after))


def find_rivals_reference(
    images: tuple[Array, Array], pixels: Array, samples: Array, noise: Array, half_width: int, infinity: float,
    reach: int,
) -> Rivals:  # fmt: skip
    """`find_rivals` in plain numpy and float64."""
    left, right = (image.astype(np.float64) for image in images)
    found = np.zeros((3, len(samples)))
    for k, (y, x) in enumerate(samples):
        rows, disparity = slice(y - HALF_ROWS, y + HALF_ROWS + 1), float(pixels[y, x])
        window = left[rows, x - half_width : x + half_width]
        variance = float(noise[int(window.mean())]) ** 2
        window = window - window.mean(axis=1, keepdims=True)
        column = floor(x - half_width - disparity)
        fraction = x - half_width - disparity - column
        strip = (1 - fraction) * right[rows, :-1] + fraction * right[rows, 1:]
        first = max(0, ceil(x - half_width - max(reach, disparity + 0.5 * reach)))
        last = min(floor(x - half_width - infinity + 1), strip.shape[1] - 2 * half_width)
        if not first <= column <= last:
            continue
        others = np.stack([strip[:, c : c + 2 * half_width] for c in range(first, last + 1)])
        costs = np.square(window - others + others.mean(axis=2, keepdims=True)).sum(axis=(1, 2))
        unlike = np.square(window).sum() - window.shape[0] * (2 * half_width - 1) * variance
        match, rival = _best_reference(costs, column - first, unlike)
        found[:, k] = np.square(window).sum() / variance, match / (2 * variance), rival / (2 * variance)
    found[2, found[2] > NONE] = NONE
    return Rivals(*found.astype(np.float32))


def _best_reference(costs: Array, found: int, unlike: float) -> tuple[float, float]:
    """`_best` in plain numpy."""
    low = costs.copy()
    before, after = costs[:-2] - costs[1:-1], costs[2:] - costs[1:-1]
    with np.errstate(invalid="ignore"):
        depth = np.square(before - after) / (8 * (before + after))
    low[1:-1] -= np.where((before >= 0) & (after >= 0) & (before + after > 0), depth, 0)
    near = np.arange(max(found - 1, 0), min(found + 2, len(costs)))
    match, rivals = low[near[costs[near].argmin()]], [np.inf]
    for side in (np.arange(found, -1, -1), np.arange(found, len(costs))):
        high = costs[side] - match >= 2 * MIN_RISE * unlike
        beyond = side[np.logical_or.accumulate(high) & ~high & (np.abs(side - found) >= MIN_DISTANCE)]
        rivals.extend(low[beyond])
    return float(match), float(min(rivals))
