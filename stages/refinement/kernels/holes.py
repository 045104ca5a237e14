"""Holes of a disparity image, filled from around as far as evidence reaches: from the far side, guided by the image.

As by Hirschmüller (2008, section 2.5.3), eight rays from each pixel find what is known about it. Here a find counts by
how near it is and how like the pixel's its colour is; behind an edge of the image it does not count at all. The pixel
takes a low quantile, so that an object has to be in the majority to be taken for what lies beside it. The
result separates occlusions from mismatches: with that disparity the right camera sees the pixel, or something hides it.
"""

from __future__ import annotations

import cv2
import numpy as np

from stages.compiled.jit import kernel
from stages.compiled.parallel import by_bands, shared_by
from stages.data import Array
from stages.refinement.kernels.valid_extent import Extent

F32 = np.float32
APART = 2.0  # px of disparity that make two surfaces
KEPT, MISMATCH, OCCLUSION, OPEN = range(4)  # kinds of pixels: not a hole, filled as either, not filled
HIDDEN = 1.0  # px by which what hides a pixel is nearer at the least
QUANTILE = 0.3  # by weight, of the disparities found
NEARBY = 32.0  # px: a find at this distance counts half of one at none
ROW = 3.0  # what a find in the row counts: what hides a pixel and what goes on behind it meet there
ALIKE = 20.0  # levels of a colour by which a find differs that counts half
UNLIKE = 60  # and beyond which it lies behind an edge
BEYOND = 2  # px behind the edge of what was found, where its colour is looked up: at the edge two mix
RAYS = np.array([(0, -1), (-1, -1), (-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1)])  # rows down, columns right
LEFT, RIGHT = 0, 4
LENGTHS = np.hypot(*RAYS.T).astype(np.float32)
WORTH = np.where(RAYS[:, 0] == 0, F32(ROW), F32(1))
NOTHING = F32(np.inf)
BYTE, EIGHT, SIXTEEN = np.uint32(255), np.uint32(8), np.uint32(16)


def fill_holes(
    disparity: Array, image: Array, within: Extent, reach: float, margin: int, threads: int = 1
) -> tuple[Array, Array]:
    """Fill the holes that evidence explains.

    disparity: (H, W) float32, px, NaN = unknown; image: (H, W) or (H, W, 3) uint8; within: how far the evidence
    reaches; reach: px within which a find counts, unless it is hidden here, and so may lie as far as what hides it;
    margin: px beyond the evidence, at the border and above, that are filled. Returns the filled image, (H, W) float32,
    and the kind of each pixel, (H, W) uint8: `KEPT`, `MISMATCH`, `OCCLUSION` or `OPEN`.
    """
    height, width = disparity.shape
    both = shared_by(threads)
    filled, colour = both(disparity.copy, lambda: _packed(cv2.blur(image, (3, 3))))
    kinds, first = np.zeros((height, width), np.uint8), np.zeros(height + 1, np.int64)
    by_bands(both, height, lambda top, end: _count(disparity, top, end, first))
    np.cumsum(first, out=first)
    holes, steps = np.empty(first[-1], np.int32), np.empty((8, first[-1]), np.int16)
    by_bands(both, height, lambda top, end: _list(disparity, top, end, first, holes))
    both(
        lambda: _trace(disparity, first, holes, 1, steps[:4]),
        lambda: _trace(disparity, first, holes, -1, steps[4:]),
    )
    given = disparity, colour, within, F32(reach), margin, first, holes, steps
    by_bands(both, height, lambda top, end: _fill(*given, top, end, filled, kinds))
    return filled, kinds


def _packed(image: Array) -> Array:
    """The colours of a gray or RGB image, (H, W) uint32: a byte each."""
    form = cv2.COLOR_GRAY2RGBA if image.ndim == 2 else cv2.COLOR_RGB2RGBA
    packed: Array = cv2.cvtColor(image, form).view(np.uint32)[..., 0]
    return packed


@kernel
def _count(disparity, begin, end, first):
    """first[y + 1]: how many holes row y has."""
    for y in range(begin, end):
        count = np.int64(0)
        for x in range(disparity.shape[1]):
            count += np.int64(disparity[y, x] != disparity[y, x])
        first[y + 1] = count


@kernel
def _list(disparity, begin, end, first, holes):
    """holes: the columns of the holes, row by row; those of row y from first[y]."""
    for y in range(begin, end):
        n = first[y]
        if first[y + 1] == n:
            continue
        for x in range(disparity.shape[1]):
            if disparity[y, x] != disparity[y, x]:
                holes[n] = x
                n += 1


@kernel
def _trace(disparity, first, holes, sign, steps):
    """How many steps along four of the `RAYS` each hole is from the first known pixel, 0 = there is none.

    sign: 1 for the rays left and up, -1 for those right and down. The next pixel is known, or has been asked before.
    """
    height, width = disparity.shape
    numbers = np.empty((2, width), np.int32)  # of the holes of this row and of the one before
    for row in range(height):
        y = row if sign > 0 else height - 1 - row
        here, before = numbers[y & 1], numbers[(y & 1) ^ 1]
        for n in range(first[y + 1] - first[y]):
            i = first[y] + n if sign > 0 else first[y + 1] - 1 - n
            x = holes[i]
            here[x] = i
            for ray in range(4):
                near_y = y - sign if ray > 0 else y
                near_x = x + sign * (ray - 2 if ray > 0 else -1)
                taken = np.int16(0)
                if 0 <= near_y < height and 0 <= near_x < width:
                    if disparity[near_y, near_x] == disparity[near_y, near_x]:
                        taken = np.int16(1)
                    else:
                        further = steps[ray, before[near_x] if ray > 0 else here[near_x]]
                        taken = np.int16(further + 1 if further > 0 else 0)
                steps[ray, i] = taken


@kernel
def _bound(row, bound):
    """bound: below which disparity each pixel of a row is hidden from the right camera by what lies right of it."""
    hidden = -NOTHING
    for back in range(row.size):
        x = row.size - 1 - back
        hidden -= F32(1)
        hidden = row[x] if row[x] > hidden else hidden
        bound[x] = hidden


@kernel
def _look(disparity, colour, y, columns, down, across, steps, values, colours):
    """What lies on one ray from each hole of a row: disparities, inf = none, and the colours beyond."""
    height, width = disparity.shape
    for i in range(columns.size):
        x, n = columns[i], np.int64(steps[i])
        values[i] = disparity[y + n * down, x + n * across] if n > 0 else NOTHING
        place_y = min(max(y + (n + BEYOND) * down, 0), height - 1)
        place_x = min(max(x + (n + BEYOND) * across, 0), width - 1)
        colours[i] = colour[place_y, place_x]


@kernel
def _weigh(own, hidden, reach, worth, length, steps, colours, values, weights):
    """What the finds on one ray count, for holes of colours `own`; what does not count becomes inf."""
    for i in range(own.size):
        one, other = own[i], colours[i]
        first = abs(np.int32(one & BYTE) - np.int32(other & BYTE))
        second = abs(np.int32((one >> EIGHT) & BYTE) - np.int32((other >> EIGHT) & BYTE))
        third = abs(np.int32((one >> SIXTEEN) & BYTE) - np.int32((other >> SIXTEEN) & BYTE))
        unlike = F32(max(first, max(second, third)))
        distance, ratio, value = length * F32(steps[i]), unlike * F32(1 / ALIKE), values[i]
        weight = worth / ((F32(1) + ratio * ratio) * (distance + F32(NEARBY)))
        counts = (unlike <= F32(UNLIKE)) & ((distance <= reach) | (value < hidden[i])) & (value < NOTHING)
        weights[i] = weight if counts else F32(0)
        values[i] = value if counts else NOTHING


@kernel
def _quantile(values, weights, total, share, least):
    """Of eight values each the least that, with all below it, has `QUANTILE` of their weight; without any weight, inf.

    values, weights: (8, >= n); total, share: (n,), to work in; least: (n,). Without sorting: each value adds up the
    weights of those not above it.
    """
    n = least.size
    total[:] = F32(0)
    for ray in range(8):
        total += weights[ray, :n]
    least[:] = NOTHING
    for ray in range(8):
        limit = values[ray, :n]
        share[:] = F32(0)
        for other in range(8):
            value, weight = values[other, :n], weights[other, :n]
            for i in range(n):
                share[i] += weight[i] if value[i] <= limit[i] else F32(0)
        for i in range(n):
            enough = share[i] >= F32(QUANTILE) * total[i]
            least[i] = min(least[i], limit[i]) if enough else least[i]


@kernel
def _fill(disparity, colour, within, reach, margin, first, holes, steps, begin, end, filled, kinds):
    width = disparity.shape[1]
    bound = np.empty(width, np.float32)
    values, weights = np.empty((8, width), np.float32), np.empty((8, width), np.float32)
    colours, room = np.empty((2, width), np.uint32), np.empty((4, width), np.float32)
    for y in range(begin, end):
        start, stop = first[y], first[y + 1]
        while start < stop and holes[start] < within.first[y] - margin:  # evidence does not reach so far
            kinds[y, holes[start]] = OPEN
            start += 1
        while start < stop and holes[stop - 1] > within.last[y] + margin:
            kinds[y, holes[stop - 1]] = OPEN
            stop -= 1
        n = stop - start
        if n == 0:
            continue
        columns, own, beyond = holes[start:stop], colours[0, :n], colours[1, :n]
        hidden, least = room[0, :n], room[1, :n]
        _bound(disparity[y], bound)
        for i in range(n):
            own[i] = colour[y, columns[i]]
            hidden[i] = bound[columns[i]] - F32(HIDDEN)
        for ray in range(8):
            taken, value, weight = steps[ray, start:stop], values[ray, :n], weights[ray, :n]
            _look(disparity, colour, y, columns, RAYS[ray, 0], RAYS[ray, 1], taken, value, beyond)
            _weigh(own, hidden, reach, WORTH[ray], LENGTHS[ray], taken, beyond, value, weight)
        _quantile(values, weights, room[2, :n], room[3, :n], least)
        for i in range(n):
            x = columns[i]
            if y < within.top[x] - margin or least[i] == NOTHING:
                kinds[y, x] = OPEN
                continue
            before, after = steps[LEFT, start + i], steps[RIGHT, start + i]
            value = _along_row(values[LEFT, i], values[RIGHT, i], before, after, least[i])
            filled[y, x] = value
            kinds[y, x] = OCCLUSION if value < hidden[i] else MISMATCH


@kernel
def _along_row(left, right, before, after, value):
    """What the row says, where that is the same surface: the line between two ends, or one of them; else the value."""
    if abs(right - left) < F32(APART):
        left += (right - left) * F32(before) / F32(before + after)
    if abs(left - value) < F32(APART):
        return left
    return right if abs(right - value) < F32(APART) else value


def fill_holes_reference(
    disparity: Array, image: Array, within: Extent, reach: float, margin: int
) -> tuple[Array, Array]:
    """`fill_holes` in plain numpy."""
    height, width = disparity.shape
    colour = cv2.blur(image, (3, 3)).reshape(height, width, -1).astype(int)
    hidden = np.full(disparity.shape, -NOTHING)
    for x in range(width - 2, -1, -1):
        hidden[:, x] = np.fmax(hidden[:, x + 1], disparity[:, x + 1]) - F32(1)
    hidden -= F32(HIDDEN)
    values, weights, taken = [], [], []
    for (down, across), length, worth in zip(RAYS, LENGTHS, WORTH, strict=True):
        value, steps, beyond = _look_reference(disparity, colour, down, across)
        unlike, distance = abs(beyond - colour).max(axis=2).astype(F32), length * steps.astype(F32)
        ratio = unlike * F32(1 / ALIKE)
        counts = (value < NOTHING) & (unlike <= UNLIKE) & ((distance <= F32(reach)) | (value < hidden))
        weights.append(np.where(counts, worth / ((F32(1) + ratio * ratio) * (distance + F32(NEARBY))), F32(0)))
        values.append(np.where(counts, value, NOTHING))
        taken.append(steps.astype(F32))
    shares = [sum(w * (v <= limit) for v, w in zip(values, weights, strict=True)) for limit in values]
    enough = np.stack(shares) >= F32(QUANTILE) * sum(weights)
    least = np.where(enough, values, NOTHING).min(axis=0)
    left, right = values[LEFT], values[RIGHT]
    with np.errstate(invalid="ignore"):
        line = left + (right - left) * taken[LEFT] / (taken[LEFT] + taken[RIGHT])
        left = np.where(abs(right - left) < APART, line, left)
        guess = np.where(abs(left - least) < APART, left, np.where(abs(right - least) < APART, right, least))
    row, column = np.mgrid[:height, :width]
    reached = (row >= within.top - margin) & (column >= within.first[:, np.newaxis] - margin)
    fill = np.isnan(disparity) & reached & (column <= within.last[:, np.newaxis] + margin) & (least < NOTHING)
    kinds = np.where(fill, np.where(guess < hidden, OCCLUSION, MISMATCH), np.where(np.isnan(disparity), OPEN, KEPT))
    return np.where(fill, guess, disparity).astype(F32), kinds.astype(np.uint8)


def _look_reference(disparity: Array, colour: Array, down: int, across: int) -> tuple[Array, Array, Array]:
    """The first disparity on a ray from each pixel, inf = none; the steps to it; the colours beyond it."""
    height, width = disparity.shape
    y, x = np.mgrid[:height, :width]
    value, steps = np.full(disparity.shape, NOTHING), np.zeros(disparity.shape, int)
    for n in range(1, max(height, width)):
        there_y, there_x = y + n * down, x + n * across
        inside = (there_y >= 0) & (there_y < height) & (there_x >= 0) & (there_x < width)
        there = disparity[np.where(inside, there_y, 0), np.where(inside, there_x, 0)]
        new = inside & (steps == 0) & ~np.isnan(there)
        value[new], steps[new] = there[new], n
    beyond = np.clip(y + (steps + BEYOND) * down, 0, height - 1), np.clip(x + (steps + BEYOND) * across, 0, width - 1)
    return value, steps, colour[beyond]
