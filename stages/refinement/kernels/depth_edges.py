"""Moves depth edges to where the images have them: a pixel beside a jump chooses between two surfaces.

A match at the edge of a rock is often one pixel off. The smallest and the largest disparity around such a pixel are its
two candidates: the ground behind and the rock in front. The log odds of the rock are a sum of two kinds of evidence. In
a window, pixels of similar colour are mostly on the same side (Yoon and Kweon, 2006). Around the pixel, the images
differ less at the right disparity. Its own row counts more, because the upper edge of a rock lies along the row. What
moved may uncover a neighbour that is off as well, so the neighbours of moved pixels choose once more. The trick: the
compiler makes vectors of the sums, as pixels are decided in batches and no number is wider than 32 bits.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from stages.compiled.jit import inlined_part, kernel
from stages.compiled.parallel import by_bands, shared_by
from stages.data import Array
from stages.refinement.kernels.colours import BYTE, GREEN, levels_apart, packed

F32 = np.float32
PASSES = 2  # the second one is of the neighbours of pixels that moved
JUMP = F32(1)  # px between neighbours at an edge of depth
UNIT = 1000  # weight of a pixel of equal colour
# Weight by levels of the channel that differs most; it falls to 1/e over 15.
WEIGHTS = np.round(UNIT * np.exp(-np.arange(256) / 15)).astype(np.int32)
# Log odds of the nearer surface: a logistic regression over edge pixels of Middlebury scenes and simulated frames. A
# pixel counts by what its choice changes, and less if only one camera sees it.
ODDS = F32(-0.3)  # without evidence
ODDS_OF_WINDOW = 7.0  # if all of it has equal colour and is on the nearer side
ODDS_PER_LEVEL = F32(0.021)  # of a level by which the images differ more at the smaller disparity than at the larger
MAX_DIFFERENCE = 12  # levels between the images that count
REACH = 2  # px, of the window that compares the images: 3 x 3 px, and 5 px in its row, which count twice
WINDOW = np.array([(v, u) for v in (-1, 0, 1) for u in range(-REACH, REACH + 1) if v == 0 or abs(u) < 2])
WINDOW_WEIGHTS = np.where(WINDOW[:, 0] == 0, 2, 1)
BATCH = 144  # pixels that are decided together
SAMPLE = 16  # rows and columns between the pixels that compare the images' exposures
FRACTIONS = 256  # of a pixel
RED_BLUE = np.uint32(0xFF00FF)  # channels that one multiplication mixes


def sharpen_edges(disparity: Array, guessed: Array, left: Array, right: Array, radius: int, threads: int = 1) -> Array:
    """Each disparity beside a jump stays, or becomes the mean of its neighbours on the other side of the jump.

    disparity: (H, W) float32, px, NaN = unknown; guessed: (H, W) bool, guesses, which do not move matches; left, right:
    (H, W) or (H, W, 3) uint8; radius: of the window, px. Returns (H, W) float32.
    """
    both = shared_by(threads)
    right = _exposed(disparity, guessed, left, right)
    height, width = disparity.shape
    layers = np.full((2, height + 2 * radius, width + 2 * radius), np.nan, np.float32)  # all disparities, matches
    padded, matches = layers
    inner = layers[:, radius : height + radius, radius : width + radius]
    inner[:] = disparity
    inner[1][guessed] = np.nan
    guide = packed(cv2.copyMakeBorder(left, radius, radius, radius, radius, cv2.BORDER_CONSTANT, value=0))
    taps = _taps(radius) @ [padded.shape[1], 1]
    window = np.stack([WINDOW @ [padded.shape[1], 1], WINDOW @ [width, 1], WINDOW_WEIGHTS])
    weight = F32(ODDS_OF_WINDOW / len(taps) / UNIT)
    given = layers, guessed, guide, packed(right), window, taps, WEIGHTS, weight, radius
    asked, moved, sharp = np.empty(disparity.shape, bool), np.empty(disparity.shape, bool), disparity.copy()
    by_bands(both, len(disparity), lambda first, end: _find_jumps(padded, radius, asked, first, end))
    for _ in range(PASSES):
        moved[:] = False
        by_bands(both, len(disparity), lambda first, end: _sharpen(*given, asked, sharp, moved, first, end))
        _settle(moved, sharp, guessed, radius, padded, matches, asked)
    return sharp


@cache
def _taps(radius: int) -> Array:
    """Offsets of every third pixel of a window from its middle: rows and columns, (n, 2)."""
    taps = np.indices((2 * radius + 1,) * 2).reshape(2, -1).T - radius
    return np.asarray(taps[(taps @ [1, 2]) % 3 == 0])


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
def _find_jumps(disparity, radius, found, first, end):
    """Mark the pixels of rows first to end with a jump to one of their eight neighbours; disparity has a border."""
    for y in range(first, end):
        above, row, below = y + radius - 1, y + radius, y + radius + 1
        start = radius - 1
        _mark_jumps(disparity[above, start:], disparity[row, start:], disparity[below, start:], found[y])


@inlined_part
def _mark_jumps(above, row, below, found):
    """Mark the pixels of a row; the rows begin one pixel before it. Every test is made, so that the loop vectorises."""
    for x in range(np.uint64(found.size)):  # without sign: numba looks for no negative index
        here, after = x + np.uint64(1), x + np.uint64(2)
        d = row[here]
        beside = (abs(row[x] - d) > JUMP) | (abs(row[after] - d) > JUMP)
        upper = (abs(above[x] - d) > JUMP) | (abs(above[here] - d) > JUMP) | (abs(above[after] - d) > JUMP)
        lower = (abs(below[x] - d) > JUMP) | (abs(below[here] - d) > JUMP) | (abs(below[after] - d) > JUMP)
        found[x] = beside | upper | lower


@kernel
def _sharpen(layers, guessed, guide, right, window, taps, table, weight, radius, asked, sharp, moved, first, end):
    """Sharpen the pixels of rows first to end that are asked; layers and guide have a border.

    layers: all disparities, which count for guesses, and those of matches, which count for matches. One array contains
    both, because numba counts references to an array that is chosen for each pixel, which takes as long as all the
    rest. The pixels are decided in batches, in which they lie side by side in the work arrays.
    """
    stride, columns, count = layers.shape[2], np.empty(sharp.shape[1] + 1, np.int64), 0
    disparities, size = layers.reshape(2, -1), right.shape
    places, sides = np.empty((3, BATCH), np.int64), np.empty((2, BATCH), np.float32)
    # Side by side: disparities and colours of the taps, the middle disparity, the own colour, weights and votes; the
    # colours that the images have in the window, the fractions, whether it lies inside, and how much they differ
    work = (
        np.empty((taps.size, BATCH), np.float32), np.empty((taps.size, BATCH), np.uint32), np.empty(BATCH, np.float32),
        np.empty(BATCH, np.uint32), np.empty(BATCH, np.int32), np.empty(BATCH, np.int32),
        np.empty((window.shape[1], 5, BATCH), np.uint32), np.empty((2, BATCH), np.uint32), np.empty(BATCH, np.bool_),
        np.empty(BATCH, np.int32),
    )  # fmt: skip
    given = (
        disparities, guessed, guide.reshape(-1), right.reshape(-1), size, window, taps, table, weight, stride, places,
        sides,
    )  # fmt: skip
    for y in range(first, end):
        for n in range(_listed(asked[y], columns)):
            x = columns[n]
            layer, at = np.uint64(not guessed[y, x]), np.int64((y + radius) * stride + x + radius)
            low, high = _candidates(disparities, layer, at, stride)
            if max(high - disparities[layer, at], disparities[layer, at] - low) > JUMP:
                places[0, count], places[1, count], places[2, count] = y, x, at
                sides[0, count], sides[1, count] = low, high
                count += 1
            if count == BATCH:
                _decide(given, count, work, sharp, moved)
                count = 0
    _decide(given, count, work, sharp, moved)


@inlined_part
def _decide(given, count, work, sharp, moved):
    """Move the first `count` pixels of a batch to the other side where the evidence says so."""
    disparities, guessed, colours, others, size, window, taps, table, weight, stride, places, sides = given
    around, shades, middles, own, weights, votes, views, shares, inside, differences = work
    for i in range(np.uint64(count)):
        y, x, at = places[0, i], places[1, i], places[2, i]
        layer = np.uint64(not guessed[y, x])
        middles[i], own[i] = F32(0.5) * (sides[0, i] + sides[1, i]), colours[at]
        for k in range(np.uint64(taps.size)):
            place = np.uint64(at + taps[k])
            around[k, i], shades[k, i] = disparities[layer, place], colours[place]
    _take_views(colours, others, size, window, places, sides, count, views, shares, inside)
    votes[:], differences[:] = 0, 0
    for k in range(taps.size):
        _add_votes(around[k], shades[k], middles, own, table, weights, votes, count)
    for k in range(window.shape[1]):
        _add_differences(views[k], shares[0], shares[1], np.int32(window[2, k]), differences, count)
    for i in range(count):
        y, x, at, middle = places[0, i], places[1, i], places[2, i], middles[i]
        layer = np.uint64(not guessed[y, x])
        odds = ODDS + weight * F32(votes[i])
        odds += ODDS_PER_LEVEL * F32(differences[i] if inside[i] else np.int32(0))
        if (odds > 0) != (disparities[layer, at] > middle):
            sharp[y, x], moved[y, x] = _neighbours(disparities, layer, at, stride, middle, odds > 0), True


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


@inlined_part
def _listed(row, columns):
    """The number of marked pixels of a row, whose columns are written to `columns`."""
    count = np.int64(0)
    for x in range(row.size):
        columns[np.uint64(count)] = x
        count += np.int64(row[x])
    return count


@inlined_part
def _candidates(disparities, layer, at, stride):
    """The smallest and largest disparity of a pixel and its neighbours."""
    low = high = disparities[layer, at]
    for row in range(-1, 2):
        for column in range(-1, 2):
            value = disparities[layer, np.uint64(at + row * stride + column)]
            low = value if value < low else low
            high = value if value > high else high
    return low, high


@inlined_part
def _add_votes(disparities, colours, middles, own, table, weights, votes, count):
    """Add the weight of one tap of each pixel, if it is above the middle disparity, or subtract it."""
    for i in range(count):
        weights[i] = levels_apart(colours[i], own[i])
    for i in range(count):
        weights[i] = table[np.uint64(weights[i])]
    for i in range(count):
        side = np.int32(disparities[i] > middles[i]) - np.int32(disparities[i] <= middles[i])  # 0 if it is unknown
        votes[i] = np.int32(votes[i] + np.int32(side * weights[i]))


@inlined_part
def _take_views(colours, others, size, window, places, sides, count, views, shares, inside):
    """Copy what the window shows in the left image, and in the right one at both disparities of each pixel of a batch.

    inside: whether the window lies inside both images. window: for each of its pixels the offsets in `colours` and in
    `others`, and the weight.
    """
    height, width = size
    for i in range(np.uint64(count)):
        y, x, at = places[0, i], places[1, i], places[2, i]
        far, near = F32(x) - sides[0, i], F32(x) - sides[1, i]
        one, two = np.int64(np.floor(far)), np.int64(np.floor(near))
        inside[i] = 1 <= y < height - 1 and REACH <= x < width - REACH and two >= REACH and one + REACH + 1 < width
        if inside[i]:
            shares[0, i], shares[1, i] = (far - F32(one)) * F32(FRACTIONS), (near - F32(two)) * F32(FRACTIONS)
            one, two = one + y * width, two + y * width
            for k in range(np.uint64(window.shape[1])):
                before, here = np.uint64(one + window[1, k]), np.uint64(two + window[1, k])
                views[k, 0, i] = colours[np.uint64(at + window[0, k])]
                views[k, 1, i], views[k, 2, i] = others[before], others[before + np.uint64(1)]
                views[k, 3, i], views[k, 4, i] = others[here], others[here + np.uint64(1)]


@inlined_part
def _add_differences(views, far_shares, near_shares, weight, total, count):
    """Add by how many levels the images differ more at the smaller disparity than at the larger, weighted."""
    colours, far, farther, near, nearer = views[0], views[1], views[2], views[3], views[4]
    for i in range(count):
        more = _difference(colours[i], far[i], farther[i], far_shares[i])
        less = _difference(colours[i], near[i], nearer[i], near_shares[i])
        total[i] = np.int32(total[i] + np.int32(weight * np.int32(more - less)))


@inlined_part
def _difference(colour, before, after, share):
    """Levels between a colour and that between two pixels of the right image."""
    rest = np.uint32(np.uint32(FRACTIONS) - share)
    mixed = np.uint32(_mix(before & RED_BLUE, after & RED_BLUE, rest, share) >> np.uint32(8)) & RED_BLUE
    green = _mix((before >> GREEN) & BYTE, (after >> GREEN) & BYTE, rest, share) & np.uint32(BYTE << GREEN)
    return np.int32(min(levels_apart(colour, np.uint32(mixed | green)), np.int32(MAX_DIFFERENCE)))


@inlined_part
def _mix(before, after, rest, share):
    return np.uint32(np.uint32(np.uint32(before) * rest) + np.uint32(np.uint32(after) * share))


@inlined_part
def _neighbours(disparities, layer, at, stride, middle, above):
    """Mean of the pixel's neighbours on one side of the middle disparity."""
    total, count = F32(0), F32(0)
    for row in range(-1, 2):
        for column in range(-1, 2):
            value = disparities[layer, np.uint64(at + row * stride + column)]
            kept = value > middle if above else value <= middle
            total += value if kept else F32(0)
            count += F32(1) if kept else F32(0)
    return total / count


def sharpen_edges_reference(disparity: Array, guessed: Array, left: Array, right: Array, radius: int) -> Array:
    """`sharpen_edges` in plain numpy, pixel by pixel."""
    right = _exposed(disparity, guessed, left, right)
    left, right = (np.atleast_3d(image).astype(np.int32) for image in (left, right))
    given = guessed, left, right, _taps(radius)
    once = _sharpened_reference(disparity, np.isfinite(disparity), *given)
    moved = np.pad(np.isfinite(disparity) & (once != disparity), 1)
    near = moved[1:-1, 1:-1] | moved[:-2, 1:-1] | moved[2:, 1:-1] | moved[1:-1, :-2] | moved[1:-1, 2:]
    return _sharpened_reference(once, np.isfinite(disparity) & near, *given)


def _sharpened_reference(
    disparity: Array, asked: Array, guessed: Array, left: Array, right: Array, taps: Array
) -> Array:
    """One pass over the pixels that are asked."""
    (height, width), sharp = disparity.shape, disparity.copy()
    for y, x in np.argwhere(asked):
        near = np.s_[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
        around = disparity[near][np.isfinite(disparity[near]) & (guessed[near] <= guessed[y, x])]
        low, high = around.min(), around.max()
        if not max(high - disparity[y, x], disparity[y, x] - low) > JUMP:
            continue
        middle = F32(0.5) * (low + high)
        rows, cols = (taps + np.array([y, x])).T
        inside = (rows >= 0) & (rows < height) & (cols >= 0) & (cols < width)
        rows, cols = rows[inside], cols[inside]
        known = np.isfinite(disparity[rows, cols]) & (guessed[rows, cols] <= guessed[y, x])
        weights = WEIGHTS[np.abs(left[rows, cols] - left[y, x]).max(axis=1)][known]
        vote = (weights * np.where(disparity[rows, cols][known] > middle, 1, -1)).sum()
        odds = ODDS + F32(ODDS_OF_WINDOW / len(taps) / UNIT) * F32(vote)
        odds += ODDS_PER_LEVEL * F32(_worse_reference(left, right, y, x, np.array([low, high])))
        if (odds > 0) != (disparity[y, x] > middle):
            side = around[(around > middle) == (odds > 0)]
            sharp[y, x] = np.cumsum(side)[-1] / F32(side.size)  # one after the other, as the kernel adds them
    return sharp


def _worse_reference(left: Array, right: Array, y: int, x: int, candidates: Array) -> int:
    """By how many levels the images around a pixel differ more at the smaller candidate, weighted."""
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
