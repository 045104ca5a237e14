"""Moves depth edges to where the images have them: a pixel beside a jump chooses between two surfaces.

A match at the edge of a rock is often one pixel off. The smallest and the largest disparity around such a pixel are its
two candidates: the ground behind and the rock in front. The log odds of the rock are a sum of two kinds of evidence. In
a window, pixels of similar brightness are mostly on the same side (Yoon and Kweon, 2006). Around the pixel, the images
differ less at the right disparity. Ground that the rock hides from the other camera differs at both disparities, so a
difference at the ground's counts less than one at the rock's.
"""

from __future__ import annotations

import itertools

import cv2
import numpy as np

from stages.compiled.jit import kernel, part
from stages.compiled.parallel import by_bands, shared_by
from stages.data import Array

F32 = np.float32
UNIT = 1000  # weight of a pixel of equal brightness
# Log odds of the nearer surface, a logistic regression over edge pixels of Middlebury scenes and simulated frames
ODDS = F32(0.32)  # without evidence
ODDS_OF_WINDOW = 6.0  # if all of it has equal brightness and is on the nearer side
ODDS_PER_FAR_LEVEL, ODDS_PER_NEAR_LEVEL = F32(0.033), F32(0.053)  # of a gray level between the images at a disparity
MAX_DIFFERENCE = F32(8)  # gray levels between the images that count
SAMPLE = 8  # rows and columns between the pixels that compare the images' exposures


def sharpen_edges(
    disparity: Array, guessed: Array, left: Array, right: Array, radius: int, jump: float, brightness: float,
    threads: int = 1,
) -> Array:  # fmt: skip
    """Each disparity beside a jump stays, or becomes the mean of its neighbours on the other side of the jump.

    disparity: (H, W) float32, px, NaN = unknown; guessed: (H, W) bool, guesses, which do not move matches; left, right:
    (H, W) uint8; radius: of the window, px; jump: px between neighbours; brightness: gray levels over which a weight
    falls to 1/e. Returns (H, W) float32.
    """
    sharp = disparity.copy()
    border = radius, radius, radius, radius, cv2.BORDER_CONSTANT
    padded = cv2.copyMakeBorder(disparity, *border, value=np.nan)
    matches = cv2.copyMakeBorder(np.where(guessed, F32(np.nan), disparity), *border, value=np.nan)
    taps = _taps(radius) @ [padded.shape[1], 1]
    guide, weight = cv2.copyMakeBorder(left, *border, value=0), F32(ODDS_OF_WINDOW / len(taps) / UNIT)
    images = left, right, *_exposure(disparity, guessed, left, right)
    given = padded, matches, guessed, guide, taps, _weights(brightness), weight, *images, radius, F32(jump)
    by_bands(shared_by(threads), len(disparity), lambda first, end: _sharpen(*given, sharp, first, end))
    return sharp


def _taps(radius: int) -> Array:
    """Offsets of every other pixel of a window from its middle: rows and columns, (n, 2)."""
    taps = np.indices((2 * radius + 1,) * 2).reshape(2, -1).T - radius
    return np.asarray(taps[taps.sum(axis=1) % 2 == 0])


def _weights(brightness: float) -> Array:
    """Weight by difference of brightness, (256,) int32, `UNIT` for none."""
    return np.asarray(np.round(UNIT * np.exp(-np.arange(256) / brightness)), np.int32)


def _exposure(disparity: Array, guessed: Array, left: Array, right: Array) -> tuple[np.float32, np.float32]:
    """Gain and offset that give the right image's matches the brightness of the left image's, by their quantiles."""
    rows, columns = np.nonzero(np.isfinite(disparity[::SAMPLE, ::SAMPLE]) & ~guessed[::SAMPLE, ::SAMPLE])
    rows, columns = rows * SAMPLE, columns * SAMPLE
    partners = np.rint(columns - disparity[rows, columns]).astype(int)
    inside = (partners >= 0) & (partners < disparity.shape[1])
    if not inside.any():
        return F32(1), F32(0)
    rows, columns, partners = rows[inside], columns[inside], partners[inside]
    low, middle, high = np.percentile([left[rows, columns], right[rows, partners]], (10, 50, 90), axis=1)
    spread = high - low
    gain = spread[0] / spread[1] if spread.all() else 1.0
    return F32(gain), F32(middle[0] - gain * middle[1])


@kernel
def _sharpen(
    disparity, matches, guessed, guide, taps, table, weight, left, right, gain, offset, radius, jump, sharp, first, end
):  # fmt: skip
    """Sharpen rows first to end; disparity, matches, guide have a border of `radius` px, taps are offsets in memory."""
    width, stride = sharp.shape[1], disparity.shape[1]
    jumps = np.empty(width, np.bool_)
    everything, certain, levels = disparity.reshape(-1), matches.reshape(-1), guide.reshape(-1)
    for y in range(first, end):
        _find_jumps(disparity, y + radius, radius, jump, jumps)
        for x in range(width):
            if jumps[x]:
                flat = everything if guessed[y, x] else certain
                at = np.int64((y + radius) * stride + x + radius)
                low, high = _candidates(flat, at, stride)
                if max(high - flat[at], flat[at] - low) > jump:
                    middle = F32(0.5) * (low + high)
                    odds = ODDS + weight * F32(_vote(flat, levels, taps, table, at, middle))
                    odds += ODDS_PER_FAR_LEVEL * _difference(left, right, gain, offset, y, x, low, high)
                    odds -= ODDS_PER_NEAR_LEVEL * _difference(left, right, gain, offset, y, x, high, low)
                    if (odds > 0) != (flat[at] > middle):
                        sharp[y, x] = _neighbours(flat, at, stride, middle, odds > 0)


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
def _candidates(flat, at, stride):
    """The smallest and largest disparity of a pixel and its neighbours."""
    low = high = flat[at]
    for row in range(-1, 2):
        for column in range(-1, 2):
            value = flat[np.uint64(at + row * stride + column)]
            low = value if value < low else low
            high = value if value > high else high
    return low, high


@part
def _vote(flat, levels, taps, table, at, middle):
    """Weight of the pixels above the middle disparity minus that of those below it."""
    own, total = np.int32(levels[at]), np.int32(0)
    for i in range(taps.size):
        place = np.uint64(at + taps[i])
        side = np.int32(flat[place] > middle) - np.int32(flat[place] <= middle)  # 0 of an unknown disparity
        total += side * table[np.uint64(abs(np.int32(levels[place]) - own))]
    return total


@part
def _difference(left, right, gain, offset, y, x, disparity, other):
    """Sum over the 3x3 pixels of the differences between the images, where the right one has both disparities."""
    height, width = left.shape
    total = F32(0)
    for v in range(max(y - 1, 0), min(y + 2, height)):
        for u in range(max(x - 1, 0), min(x + 2, width)):
            place, there = F32(u) - disparity, F32(u) - other
            if min(place, there) >= F32(0) and max(place, there) < F32(width - 1):
                i = np.int64(place)
                share = place - F32(i)
                value = F32(right[v, i]) * (F32(1) - share) + F32(right[v, i + 1]) * share
                total += min(abs(F32(left[v, u]) - (gain * value + offset)), MAX_DIFFERENCE)
    return total


@part
def _neighbours(flat, at, stride, middle, above):
    """Mean of the pixel's neighbours on one side of the middle disparity."""
    total, count = F32(0), F32(0)
    for row in range(-1, 2):
        for column in range(-1, 2):
            value = flat[np.uint64(at + row * stride + column)]
            if value > middle if above else value <= middle:
                total += value
                count += F32(1)
    return total / count


def sharpen_edges_reference(
    disparity: Array, guessed: Array, left: Array, right: Array, radius: int, jump: float, brightness: float
) -> Array:
    """`sharpen_edges` in plain numpy, pixel by pixel."""
    height, width = disparity.shape
    gain, offset = _exposure(disparity, guessed, left, right)
    table, taps, sharp = _weights(brightness), _taps(radius), disparity.copy()

    def differences(y: int, x: int, candidates: tuple[np.float32, np.float32]) -> Array:
        sums = np.zeros(2, np.float32)
        for v, u in itertools.product(range(y - 1, y + 2), range(x - 1, x + 2)):
            places = F32(u) - np.array(candidates)
            if 0 <= v < height and 0 <= u < width and places.min() >= 0 and places.max() < width - 1:
                i = places.astype(int)
                values = right[v, i] * (F32(1) - (places - i)) + right[v, i + 1] * (places - i)
                sums += np.minimum(np.abs(F32(left[v, u]) - (gain * values + offset)), MAX_DIFFERENCE)
        return sums

    for y, x in np.argwhere(np.isfinite(disparity)):
        near = np.s_[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
        around = disparity[near][np.isfinite(disparity[near]) & (guessed[near] <= guessed[y, x])]
        low, high = around.min(), around.max()
        if not max(high - disparity[y, x], disparity[y, x] - low) > F32(jump):
            continue
        middle = F32(0.5) * (low + high)
        rows, cols = (taps + np.array([y, x])).T
        inside = (rows >= 0) & (rows < height) & (cols >= 0) & (cols < width)
        rows, cols = rows[inside], cols[inside]
        known = np.isfinite(disparity[rows, cols]) & (guessed[rows, cols] <= guessed[y, x])
        weights = table[np.abs(left[rows, cols].astype(int) - int(left[y, x]))][known]
        vote = (weights * np.where(disparity[rows, cols][known] > middle, 1, -1)).sum()
        far, close = differences(y, x, (low, high))
        odds = (
            ODDS
            + F32(ODDS_OF_WINDOW / len(taps) / UNIT) * F32(vote)
            + ODDS_PER_FAR_LEVEL * far
            - ODDS_PER_NEAR_LEVEL * close
        )
        if (odds > 0) != (disparity[y, x] > middle):
            side = around[(around > middle) == (odds > 0)]
            sharp[y, x] = np.cumsum(side)[-1] / F32(side.size)  # one after the other, as the kernel adds them
    return sharp
