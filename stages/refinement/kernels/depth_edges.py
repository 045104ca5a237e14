"""Moves depth edges to where the images have them: a pixel beside a jump chooses between two surfaces.

A match at the edge of a rock is often one pixel off. The smallest and the largest disparity around such a pixel are its
two candidates: the ground behind and the rock in front. The log odds of the rock are a sum of two kinds of evidence. In
a window, pixels of similar colour are mostly on the same side (Yoon and Kweon, 2006). Around the pixel, the images
differ less at the right disparity. Its own row counts more, because the upper edge of a rock lies along the row. What
moved may uncover a neighbour that is off as well, so the neighbours of moved pixels choose once more.
"""

from __future__ import annotations

import cv2
import numpy as np

from stages.compiled.jit import kernel, part
from stages.compiled.parallel import by_bands, shared_by
from stages.data import Array
from stages.refinement.kernels.colours import BYTE, GREEN, levels_apart, packed

F32 = np.float32
PASSES = 2  # the second one is of the neighbours of pixels that moved
UNIT = 1000  # weight of a pixel of equal colour
# Log odds of the nearer surface: a logistic regression over edge pixels of Middlebury scenes and simulated frames. A
# pixel counts by what its choice changes, and less if only one camera sees it.
ODDS = F32(-0.3)  # without evidence
ODDS_OF_WINDOW = 7.0  # if all of it has equal colour and is on the nearer side
ODDS_PER_LEVEL = F32(0.021)  # of a level by which the images differ more at the smaller disparity than at the larger
MAX_DIFFERENCE = 12  # levels between the images that count
REACH = 2  # px, of the window that compares the images: 3 x 3 px, and 5 px in its row, which count twice
WINDOW = np.array([(v, u) for v in (-1, 0, 1) for u in range(-REACH, REACH + 1) if v == 0 or abs(u) < 2])
WINDOW_WEIGHTS = np.where(WINDOW[:, 0] == 0, 2, 1)
SAMPLE = 16  # rows and columns between the pixels that compare the images' exposures
FRACTIONS = 256  # of a pixel
RED_BLUE = np.uint32(0xFF00FF)  # channels that one multiplication mixes


def sharpen_edges(
    disparity: Array, guessed: Array, left: Array, right: Array, radius: int, jump: float, colour: float,
    threads: int = 1,
) -> Array:  # fmt: skip
    """Each disparity beside a jump stays, or becomes the mean of its neighbours on the other side of the jump.

    disparity: (H, W) float32, px, NaN = unknown; guessed: (H, W) bool, guesses, which do not move matches; left, right:
    (H, W) or (H, W, 3) uint8; radius: of the window, px; jump: px between neighbours; colour: levels of the channel
    that differs most, over which a weight falls to 1/e. Returns (H, W) float32.
    """
    both = shared_by(threads)
    right = _exposed(disparity, guessed, left, right)
    border = radius, radius, radius, radius, cv2.BORDER_CONSTANT
    padded = cv2.copyMakeBorder(disparity, *border, value=np.nan)
    matches = cv2.copyMakeBorder(np.where(guessed, F32(np.nan), disparity), *border, value=np.nan)
    guide, other = packed(cv2.copyMakeBorder(left, *border, value=0)), packed(right)
    taps = _taps(radius) @ [padded.shape[1], 1]
    window = np.stack([WINDOW @ [padded.shape[1], 1], WINDOW @ [disparity.shape[1], 1], WINDOW_WEIGHTS])
    weight = F32(ODDS_OF_WINDOW / len(taps) / UNIT)
    given = padded, matches, guessed, guide, other, window, taps, _weights(colour), weight, radius, F32(jump)
    asked, moved, sharp = np.empty(disparity.shape, bool), np.empty(disparity.shape, bool), disparity.copy()
    by_bands(both, len(disparity), lambda first, end: _find_jumps(padded, radius, F32(jump), asked, first, end))
    for _ in range(PASSES):
        moved[:] = False
        by_bands(both, len(disparity), lambda first, end: _sharpen(*given, asked, sharp, moved, first, end))
        _settle(moved, sharp, guessed, radius, padded, matches, asked)
    return sharp


def _taps(radius: int) -> Array:
    """Offsets of every third pixel of a window from its middle: rows and columns, (n, 2)."""
    taps = np.indices((2 * radius + 1,) * 2).reshape(2, -1).T - radius
    return np.asarray(taps[(taps @ [1, 2]) % 3 == 0])


def _weights(colour: float) -> Array:
    """Weight by difference of colour, (256,) int32, `UNIT` for none."""
    return np.asarray(np.round(UNIT * np.exp(-np.arange(256) / colour)), np.int32)


def _exposed(disparity: Array, guessed: Array, left: Array, right: Array) -> Array:
    """The right image with the exposure of the left one: a gain and an offset by the quantiles of matches."""
    rows, columns = np.nonzero(np.isfinite(disparity[::SAMPLE, ::SAMPLE]) & ~guessed[::SAMPLE, ::SAMPLE])
    rows, columns = rows * SAMPLE, columns * SAMPLE
    partners = np.rint(columns - disparity[rows, columns]).astype(int)
    inside = (partners >= 0) & (partners < disparity.shape[1])
    if not inside.any():
        return right
    rows, columns, partners = rows[inside], columns[inside], partners[inside]
    levels = np.stack([left[rows, columns], right[rows, partners]]).reshape(2, -1)
    low, middle, high = np.percentile(levels, (10, 50, 90), axis=1)
    spread = high - low
    gain = spread[0] / spread[1] if spread.all() else 1.0
    levels = np.arange(256) * gain + (middle[0] - gain * middle[1])
    exposed: Array = cv2.LUT(right, np.clip(np.rint(levels), 0, 255).astype(np.uint8))
    return exposed


@kernel
def _find_jumps(disparity, radius, jump, found, first, end):
    """Mark the pixels of rows first to end with a jump to one of their eight neighbours; disparity has a border."""
    for y in range(first, end):
        rows = disparity[y + radius - 1 : y + radius + 2, radius - 1 :]
        _mark_jumps(rows[0], rows[1], rows[2], jump, found[y])


@part
def _mark_jumps(above, row, below, jump, found):
    """Mark the pixels of a row; the rows begin one pixel before it."""
    for x in range(found.size):
        d, most = row[x + 1], F32(0)
        most = _larger(abs(row[x] - d), _larger(abs(row[x + 2] - d), most))
        most = _larger(abs(above[x] - d), _larger(abs(above[x + 1] - d), _larger(abs(above[x + 2] - d), most)))
        most = _larger(abs(below[x] - d), _larger(abs(below[x + 1] - d), _larger(abs(below[x + 2] - d), most)))
        found[x] = most > jump


@part
def _larger(value, most):
    return value if value > most else most  # which leaves out an unknown value


@kernel
def _sharpen(
    disparity, matches, guessed, guide, right, window, taps, table, weight, radius, jump, asked, sharp, moved,
    first, end,
):  # fmt: skip
    """Sharpen the pixels of rows first to end that are asked; disparity, matches and guide have a border."""
    stride, columns = disparity.shape[1], np.empty(sharp.shape[1] + 1, np.int64)
    everything, certain, colours = disparity.reshape(-1), matches.reshape(-1), guide.reshape(-1)
    for y in range(first, end):
        for n in range(_listed(asked[y], columns)):
            x = columns[n]
            flat = everything if guessed[y, x] else certain
            at = np.int64((y + radius) * stride + x + radius)
            low, high = _candidates(flat, at, stride)
            if max(high - flat[at], flat[at] - low) > jump:
                middle = F32(0.5) * (low + high)
                odds = ODDS + weight * F32(_vote(flat, colours, taps, table, at, middle))
                odds += ODDS_PER_LEVEL * F32(_worse(colours, at, right, window, y, x, low, high))
                if (odds > 0) != (flat[at] > middle):
                    sharp[y, x], moved[y, x] = _neighbours(flat, at, stride, middle, odds > 0), True


@kernel
def _settle(moved, sharp, guessed, radius, padded, matches, asked):
    """Copy what moved into the images with a border; asked become these pixels and their neighbours."""
    height, width = moved.shape
    columns = np.empty(width + 1, np.int64)
    asked[:] = False
    for y in range(height):
        for n in range(_listed(moved[y], columns)):
            x = columns[n]
            padded[y + radius, x + radius] = sharp[y, x]
            if not guessed[y, x]:
                matches[y + radius, x + radius] = sharp[y, x]
            asked[y, x] = asked[max(y - 1, 0), x] = asked[min(y + 1, height - 1), x] = True
            asked[y, max(x - 1, 0)] = asked[y, min(x + 1, width - 1)] = True


@part
def _listed(row, columns):
    """The number of marked pixels of a row, whose columns are written to `columns`."""
    count = np.int64(0)
    for x in range(row.size):
        columns[np.uint64(count)] = x
        count += np.int64(row[x])
    return count


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
def _vote(flat, colours, taps, table, at, middle):
    """Weight of the pixels above the middle disparity minus that of those below it."""
    own, total = colours[at], np.int32(0)
    for i in range(taps.size):
        place = np.uint64(at + taps[i])
        side = np.int32(flat[place] > middle) - np.int32(flat[place] <= middle)  # 0 of an unknown disparity
        total += side * table[np.uint64(levels_apart(colours[place], own))]
    return total


@part
def _worse(colours, at, right, window, y, x, low, high):
    """By how many levels the images around a pixel differ more at the disparity `low` than at `high`, weighted.

    It is 0 where the window leaves an image. window: for each of its pixels the offsets in `colours` and in `right`,
    and the weight.
    """
    height, width = right.shape
    others, far, near, total = right.reshape(-1), F32(x) - low, F32(x) - high, np.int32(0)
    i, j = np.int64(np.floor(far)), np.int64(np.floor(near))
    inside = 1 <= y < height - 1 and REACH <= x < width - REACH and j >= REACH and i + REACH + 1 < width
    if not inside:
        return total
    far_share, near_share = np.uint32((far - F32(i)) * F32(FRACTIONS)), np.uint32((near - F32(j)) * F32(FRACTIONS))
    i, j = i + y * width, j + y * width
    for k in range(window.shape[1]):
        colour = colours[np.uint64(at + window[0, k])]
        here = _difference(colour, others, i + window[1, k], far_share)
        total += np.int32(window[2, k]) * (here - _difference(colour, others, j + window[1, k], near_share))
    return total


@part
def _difference(colour, others, place, share):
    """Levels between a colour and that between two pixels of the right image."""
    before, after = others[np.uint64(place)], others[np.uint64(place + 1)]
    rest = np.uint32(FRACTIONS) - share
    mixed = (((before & RED_BLUE) * rest + (after & RED_BLUE) * share) >> np.uint32(8)) & RED_BLUE
    mixed |= (((before >> GREEN) & BYTE) * rest + ((after >> GREEN) & BYTE) * share) & (BYTE << GREEN)
    return min(levels_apart(colour, mixed), np.int32(MAX_DIFFERENCE))


@part
def _neighbours(flat, at, stride, middle, above):
    """Mean of the pixel's neighbours on one side of the middle disparity."""
    total, count = F32(0), F32(0)
    for row in range(-1, 2):
        for column in range(-1, 2):
            value = flat[np.uint64(at + row * stride + column)]
            kept = value > middle if above else value <= middle
            total += value if kept else F32(0)
            count += F32(1) if kept else F32(0)
    return total / count


def sharpen_edges_reference(
    disparity: Array, guessed: Array, left: Array, right: Array, radius: int, jump: float, colour: float
) -> Array:
    """`sharpen_edges` in plain numpy, pixel by pixel."""
    right = _exposed(disparity, guessed, left, right)
    left, right = (np.atleast_3d(image).astype(np.int32) for image in (left, right))
    given = guessed, left, right, _taps(radius), _weights(colour), F32(jump)
    once = _sharpened_reference(disparity, np.isfinite(disparity), *given)
    moved = np.pad(np.isfinite(disparity) & (once != disparity), 1)
    near = moved[1:-1, 1:-1] | moved[:-2, 1:-1] | moved[2:, 1:-1] | moved[1:-1, :-2] | moved[1:-1, 2:]
    return _sharpened_reference(once, np.isfinite(disparity) & near, *given)


def _sharpened_reference(
    disparity: Array, asked: Array, guessed: Array, left: Array, right: Array, taps: Array,
    table: Array, jump: np.float32,
) -> Array:  # fmt: skip
    """One pass over the pixels that are asked."""
    (height, width), sharp = disparity.shape, disparity.copy()
    for y, x in np.argwhere(asked):
        near = np.s_[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
        around = disparity[near][np.isfinite(disparity[near]) & (guessed[near] <= guessed[y, x])]
        low, high = around.min(), around.max()
        if not max(high - disparity[y, x], disparity[y, x] - low) > jump:
            continue
        middle = F32(0.5) * (low + high)
        rows, cols = (taps + np.array([y, x])).T
        inside = (rows >= 0) & (rows < height) & (cols >= 0) & (cols < width)
        rows, cols = rows[inside], cols[inside]
        known = np.isfinite(disparity[rows, cols]) & (guessed[rows, cols] <= guessed[y, x])
        weights = table[np.abs(left[rows, cols] - left[y, x]).max(axis=1)][known]
        vote = (weights * np.where(disparity[rows, cols][known] > middle, 1, -1)).sum()
        odds = ODDS + F32(ODDS_OF_WINDOW / len(taps) / UNIT) * F32(vote)
        odds += ODDS_PER_LEVEL * F32(_worse_reference(left, right, y, x, np.array([low, high])))
        if (odds > 0) != (disparity[y, x] > middle):
            side = around[(around > middle) == (odds > 0)]
            sharp[y, x] = np.cumsum(side)[-1] / F32(side.size)  # one after the other, as the kernel adds them
    return sharp


def _worse_reference(left: Array, right: Array, y: int, x: int, candidates: Array) -> int:
    """`_worse` in plain numpy."""
    (height, width, _), total = left.shape, 0
    places = F32(x) - candidates
    whole = np.floor(places).astype(int)
    shares = ((places - whole.astype(np.float32)) * F32(FRACTIONS)).astype(int)[:, np.newaxis]
    if not (1 <= y < height - 1 and REACH <= x < width - REACH and whole.min() >= REACH <= width - 2 - whole.max()):
        return 0
    for (down, across), weight in zip(WINDOW, WINDOW_WEIGHTS, strict=True):
        v, i = y + down, whole + across
        mixed = (right[v, i] * (FRACTIONS - shares) + right[v, i + 1] * shares) // FRACTIONS
        far, near = np.minimum(np.abs(left[v, x + across] - mixed).max(axis=1), MAX_DIFFERENCE)
        total += weight * int(far - near)
    return total
