"""Fills holes of a disparity image from the background, guided by the image (Hirschmüller, 2008, section 2.5.3).

Eight rays from each hole find the nearest known disparities. Each is weighted by its distance and by its colour's
similarity to the hole's. A disparity behind an image edge does not count. The hole takes a low weighted quantile, so
the farther surface wins unless most of the weight is on the nearer one. A hole is an occlusion if, at its new
disparity, a nearer surface in its row hides it from the right camera. Otherwise it is a mismatch.
"""

from __future__ import annotations

import cv2
import numpy as np

from stages.compiled.jit import inlined_part, kernel
from stages.compiled.parallel import by_bands, shared_by
from stages.data import Array
from stages.refinement.kernels.colours import levels_apart, packed
from stages.refinement.kernels.valid_extent import Extent

F32 = np.float32
MIN_SURFACE_STEP = 2.0  # px of disparity between two surfaces
KEPT, MISMATCH, OCCLUSION, OPEN, BRIDGE = range(5)  # kinds of pixels: no hole, filled as either, not filled, bridged
MIN_OCCLUDER_STEP = 1.0  # px of disparity by which an occluder is nearer
FILL_QUANTILE = 0.3  # share of the weight at or below the disparity that a hole takes
HALF_WEIGHT_DISTANCE = 32.0  # px at which a weight is half of that at distance 0
ROW_WEIGHT = 3.0  # of rays along the row, where an occluder and the surface behind it meet
HALF_WEIGHT_COLOUR = 20.0  # levels of colour difference at which a weight is halved
MAX_COLOUR_DIFFERENCE = 60  # levels; a larger difference means an image edge in between
COLOUR_OFFSET = 2  # px behind the found pixel, where its colour is read; at its edge two colours mix
RAYS = np.array([(0, -1), (-1, -1), (-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1)])  # rows down, columns right
LEFT, RIGHT = 0, 4
STEP_LENGTHS = np.hypot(*RAYS.T).astype(np.float32)
RAY_WEIGHTS = np.where(RAYS[:, 0] == 0, F32(ROW_WEIGHT), F32(1))
NO_VALUE = F32(np.inf)


def fill_holes(
    disparity: Array, image: Array, within: Extent, max_distance: float, margin: int, threads: int = 1
) -> tuple[Array, Array]:
    """Fill holes up to `margin` px outside the valid extent `within`.

    disparity: (H, W) float32, px, NaN = hole; image: (H, W) or (H, W, 3) uint8; max_distance: px, of the known
    disparities that count; an occluded surface counts from any distance. Returns the filled image, (H, W) float32, and
    the kind of each pixel, (H, W) uint8: `KEPT`, `MISMATCH`, `OCCLUSION` or `OPEN`.
    """
    height, width = disparity.shape
    both = shared_by(threads)
    filled, colour = both(disparity.copy, lambda: packed(cv2.blur(image, (3, 3))))
    kinds, first = np.zeros((height, width), np.uint8), np.zeros(height + 1, np.int64)
    holes = np.empty(disparity.size, np.int32)
    _list_holes(disparity, first, holes)
    steps = np.empty((8, first[-1]), np.int16)
    both(
        lambda: _count_steps(disparity, first, holes, 1, steps[:4]),
        lambda: _count_steps(disparity, first, holes, -1, steps[4:]),
    )
    given = disparity, colour, within, F32(max_distance), margin, first, holes, steps
    by_bands(both, height, lambda top, end: _fill(*given, top, end, filled, kinds))
    return filled, kinds


@kernel
def _list_holes(disparity, first, holes):
    """holes becomes the columns of the holes; row y has those from first[y] to first[y + 1]."""
    n = 0
    for y in range(disparity.shape[0]):
        for x in range(disparity.shape[1]):
            if disparity[y, x] != disparity[y, x]:
                holes[n] = x
                n += 1
        first[y + 1] = n


@kernel
def _count_steps(disparity, first, holes, sign, steps):
    """Steps along four of the `RAYS` from each hole to the first known pixel, 0 = none.

    sign: 1 for the rays left and up, -1 for those right and down. The next pixel on a ray is known or a hole whose
    steps are already counted.
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


@inlined_part
def _occlusion_limit(row, bound):
    """bound becomes, per pixel of a row, the disparity below which the right camera does not see it."""
    hidden = -NO_VALUE
    for back in range(row.size):
        x = row.size - 1 - back
        hidden -= F32(1)
        hidden = row[x] if row[x] > hidden else hidden
        bound[x] = hidden


@inlined_part
def _read_ray(disparity, colour, y, columns, down, across, steps, values, colours):
    """First disparity on one ray from each hole of a row, inf = none, and the colour behind it."""
    height, width = disparity.shape
    for i in range(columns.size):
        x, n = columns[i], np.int64(steps[i])
        values[i] = disparity[y + n * down, x + n * across] if n > 0 else NO_VALUE
        place_y = min(max(y + (n + COLOUR_OFFSET) * down, 0), height - 1)
        place_x = min(max(x + (n + COLOUR_OFFSET) * across, 0), width - 1)
        colours[i] = colour[place_y, place_x]


@inlined_part
def _weigh_ray(own, hidden, max_distance, ray_weight, length, steps, colours, values, weights):
    """Weights of the disparities on one ray for holes of colours `own`; a value without weight becomes inf."""
    for i in range(own.size):
        colour_difference = F32(levels_apart(own[i], colours[i]))
        distance, ratio, value = length * F32(steps[i]), colour_difference * F32(1 / HALF_WEIGHT_COLOUR), values[i]
        weight = ray_weight / ((F32(1) + ratio * ratio) * (distance + F32(HALF_WEIGHT_DISTANCE)))
        counts = (
            (colour_difference <= F32(MAX_COLOUR_DIFFERENCE))
            & ((distance <= max_distance) | (value < hidden[i]))
            & (value < NO_VALUE)
        )
        weights[i] = weight if counts else F32(0)
        values[i] = value if counts else NO_VALUE


@inlined_part
def _quantile(values, weights, total, share, least):
    """The weighted quantile `FILL_QUANTILE` of eight values per hole, inf where all weights are 0.

    values, weights: (8, >= n); total, share: (n,) scratch; least: (n,) result. Nothing is sorted: each value sums the
    weights of the values not above it.
    """
    n = least.size
    total[:] = F32(0)
    for ray in range(8):
        total += weights[ray, :n]
    least[:] = NO_VALUE
    for ray in range(8):
        limit = values[ray, :n]
        share[:] = F32(0)
        for other in range(8):
            value, weight = values[other, :n], weights[other, :n]
            for i in range(n):
                share[i] += weight[i] if value[i] <= limit[i] else F32(0)
        for i in range(n):
            enough = share[i] >= F32(FILL_QUANTILE) * total[i]
            least[i] = min(least[i], limit[i]) if enough else least[i]


@kernel
def _fill(disparity, colour, within, max_distance, margin, first, holes, steps, begin, end, filled, kinds):
    width = disparity.shape[1]
    bound = np.empty(width, np.float32)
    values, weights = np.empty((8, width), np.float32), np.empty((8, width), np.float32)
    colours, room = np.empty((2, width), np.uint32), np.empty((4, width), np.float32)
    for y in range(begin, end):
        start, stop = first[y], first[y + 1]
        while start < stop and holes[start] < within.first[y] - margin:  # outside the valid extent
            kinds[y, holes[start]] = OPEN
            start += 1
        while start < stop and holes[stop - 1] > within.last[y] + margin:
            kinds[y, holes[stop - 1]] = OPEN
            stop -= 1
        n = stop - start
        if n == 0:
            continue
        columns, own, colour_beyond = holes[start:stop], colours[0, :n], colours[1, :n]
        hidden, least = room[0, :n], room[1, :n]
        _occlusion_limit(disparity[y], bound)
        for i in range(n):
            own[i] = colour[y, columns[i]]
            hidden[i] = bound[columns[i]] - F32(MIN_OCCLUDER_STEP)
        for ray in range(8):
            taken, value, weight = steps[ray, start:stop], values[ray, :n], weights[ray, :n]
            _read_ray(disparity, colour, y, columns, RAYS[ray, 0], RAYS[ray, 1], taken, value, colour_beyond)
            _weigh_ray(
                own, hidden, max_distance, RAY_WEIGHTS[ray], STEP_LENGTHS[ray], taken, colour_beyond, value, weight
            )
        _quantile(values, weights, room[2, :n], room[3, :n], least)
        for i in range(n):
            x = columns[i]
            if y < within.top[x] - margin or least[i] == NO_VALUE:
                kinds[y, x] = OPEN
                continue
            before, after = steps[LEFT, start + i], steps[RIGHT, start + i]
            value = _row_value(values[LEFT, i], values[RIGHT, i], before, after, least[i])
            filled[y, x] = value
            kinds[y, x] = OCCLUSION if value < hidden[i] else MISMATCH


@inlined_part
def _row_value(left, right, before, after, value):
    """`value`, or the row's end on the same surface, interpolated where both ends are."""
    if abs(right - left) < F32(MIN_SURFACE_STEP):
        left += (right - left) * F32(before) / F32(before + after)
    if abs(left - value) < F32(MIN_SURFACE_STEP):
        return left
    return right if abs(right - value) < F32(MIN_SURFACE_STEP) else value


def fill_holes_reference(
    disparity: Array, image: Array, within: Extent, max_distance: float, margin: int
) -> tuple[Array, Array]:
    """`fill_holes` in plain numpy."""
    height, width = disparity.shape
    colour = cv2.blur(image, (3, 3)).reshape(height, width, -1).astype(int)
    hidden = np.full(disparity.shape, -NO_VALUE)
    for x in range(width - 2, -1, -1):
        hidden[:, x] = np.fmax(hidden[:, x + 1], disparity[:, x + 1]) - F32(1)
    hidden -= F32(MIN_OCCLUDER_STEP)
    values, weights, taken = [], [], []
    for (down, across), length, ray_weight in zip(RAYS, STEP_LENGTHS, RAY_WEIGHTS, strict=True):
        value, steps, colour_beyond = _read_ray_reference(disparity, colour, down, across)
        colour_difference, distance = abs(colour_beyond - colour).max(axis=2).astype(F32), length * steps.astype(F32)
        ratio = colour_difference * F32(1 / HALF_WEIGHT_COLOUR)
        counts = (
            (value < NO_VALUE)
            & (colour_difference <= MAX_COLOUR_DIFFERENCE)
            & ((distance <= F32(max_distance)) | (value < hidden))
        )
        weights.append(
            np.where(counts, ray_weight / ((F32(1) + ratio * ratio) * (distance + F32(HALF_WEIGHT_DISTANCE))), F32(0))
        )
        values.append(np.where(counts, value, NO_VALUE))
        taken.append(steps.astype(F32))
    shares = [sum(w * (v <= limit) for v, w in zip(values, weights, strict=True)) for limit in values]
    enough = np.stack(shares) >= F32(FILL_QUANTILE) * sum(weights)
    least = np.where(enough, values, NO_VALUE).min(axis=0)
    left, right = values[LEFT], values[RIGHT]
    with np.errstate(invalid="ignore"):
        line = left + (right - left) * taken[LEFT] / (taken[LEFT] + taken[RIGHT])
        left = np.where(abs(right - left) < MIN_SURFACE_STEP, line, left)
        guess = np.where(
            abs(left - least) < MIN_SURFACE_STEP, left, np.where(abs(right - least) < MIN_SURFACE_STEP, right, least)
        )
    row, column = np.mgrid[:height, :width]
    reached = (row >= within.top - margin) & (column >= within.first[:, np.newaxis] - margin)
    fill = np.isnan(disparity) & reached & (column <= within.last[:, np.newaxis] + margin) & (least < NO_VALUE)
    kinds = np.where(fill, np.where(guess < hidden, OCCLUSION, MISMATCH), np.where(np.isnan(disparity), OPEN, KEPT))
    return np.where(fill, guess, disparity).astype(F32), kinds.astype(np.uint8)


def _read_ray_reference(disparity: Array, colour: Array, down: int, across: int) -> tuple[Array, Array, Array]:
    """The first disparity on a ray from each pixel, inf = none; the steps to it; the colour behind it."""
    height, width = disparity.shape
    y, x = np.mgrid[:height, :width]
    value, steps = np.full(disparity.shape, NO_VALUE), np.zeros(disparity.shape, int)
    for n in range(1, max(height, width)):
        there_y, there_x = y + n * down, x + n * across
        inside = (there_y >= 0) & (there_y < height) & (there_x >= 0) & (there_x < width)
        there = disparity[np.where(inside, there_y, 0), np.where(inside, there_x, 0)]
        new = inside & (steps == 0) & ~np.isnan(there)
        value[new], steps[new] = there[new], n
    colour_beyond = (
        np.clip(y + (steps + COLOUR_OFFSET) * down, 0, height - 1),
        np.clip(x + (steps + COLOUR_OFFSET) * across, 0, width - 1),
    )
    return value, steps, colour[colour_beyond]
