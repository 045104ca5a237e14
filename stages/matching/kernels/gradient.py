"""The matching cost: census and gradient difference of the pixels, smoothed over 3x3.

raw = 2 * (census bits that differ, 0..24) + 5 * min(|difference of dx| + |difference of dy|, 6)
Census distinguishes textured patches at any exposure; the truncated gradient difference adds the amount of contrast,
which census ignores. The sum over 3 columns (at most 234) and the binomial mean (1, 2, 1) over 3 rows fit a byte.
Where a prior is steep, as on the flank of a rock, the mean follows it: the rows above and below count at disparities
1 px to either side. The trick: only the column sums of the last two rows are kept, and those of the next row are
computed when the sweep reaches it, so no cost is ever stored for the whole image.
"""

from __future__ import annotations

import cv2
import numpy as np

from stages.compiled.jit import kernel, part
from stages.compiled.simd import (
    Width,
    average,
    bit_and,
    bit_or,
    broadcast,
    byte,
    difference,
    lanes_in,
    lesser,
    load,
    minus_capped,
    plus,
    plus_capped,
    shifted,
    store,
)  # fmt: skip
from stages.data import Array
from stages.matching.kernels.census import differing_bits

DX, DY = 3, 4  # after the planes of census
PLANES = 5
LANES = 64  # pixels at a time
MAX_GRADIENT_DIFFERENCE = 6
NO_GRADIENT = 128
WORD = 8  # slopes that are looked at together
SLOPE_REACH = 5  # rows to either side, between which a slope is measured
MIN_RISE, MAX_RISE = 4.5, 10.0  # px between these rows; what rises more is a depth edge
NOT_SEARCHED = 255  # cost beyond either end of the search range


def gradients(image: Array, planes: Array, mirrored: bool = False) -> None:
    """Write dx and dy of each pixel (Sobel / 4, gray levels a pixel, plus 128, within 1 to 255) into `planes`.

    image: (H, W) uint8, its own border replicated beyond; planes: (H, 5, at least W rounded up to 64) uint8, of which
    the last two are written, in more than W columns; mirrored: the image is flipped left to right, and dx is that of
    the image before the flip.
    """
    columns = -(-image.shape[1] // LANES) * LANES
    padded = cv2.copyMakeBorder(image, 1, 1, 1, 1 + columns - image.shape[1], cv2.BORDER_REPLICATE)
    _gradients(padded, -1 if mirrored else 1, planes, columns, Width(LANES))


@kernel
def _gradients(image, sign, planes, columns, width):
    stride = image.shape[1]
    for y in range(planes.shape[0]):
        dx, dy = planes[y, DX], planes[y, DY]
        for x in range(0, columns, lanes_in(width)):
            at = (y + 1) * stride + x + 1
            west, east = _smooth(image, at - sign, stride, width), _smooth(image, at + sign, stride, width)
            north, south = _smooth(image, at - stride, 1, width), _smooth(image, at + stride, 1, width)
            store(dx, x, _signed_difference(east, west, width))
            store(dy, x, _signed_difference(south, north, width))


@part
def _smooth(image, at, stride, width):
    """Weighted mean of three pixels `stride` apart; the middle one, at `at`, counts twice."""
    ends = average(load(image, at - stride, width), load(image, at + stride, width))
    return average(ends, load(image, at, width))


@part
def _signed_difference(more, less, width):
    most = broadcast(NO_GRADIENT - 1, width)
    above = plus_capped(broadcast(NO_GRADIENT, width), lesser(minus_capped(more, less), most))
    return minus_capped(above, lesser(minus_capped(less, more), most))


def gradients_reference(image: Array, mirrored: bool = False) -> Array:
    """The planes of `gradients`, (H, 2, W) uint8, in plain numpy."""
    padded = np.pad(image.astype(np.int64), 1, mode="edge")
    if mirrored:
        return np.ascontiguousarray(gradients_reference(image[:, ::-1])[:, :, ::-1])

    def mean(one: Array, middle: Array, other: Array) -> Array:
        return ((one + other + 1) // 2 + middle + 1) // 2

    columns, rows = mean(padded[:-2], padded[1:-1], padded[2:]), mean(padded[:, :-2], padded[:, 1:-1], padded[:, 2:])
    planes = np.stack([columns[:, 2:] - columns[:, :-2], rows[2:] - rows[:-2]], axis=1)
    result: Array = np.clip(planes + NO_GRADIENT, 1, 255).astype(np.uint8)
    return result


def steep_slope(prior: Array) -> Array:
    """Whether disparity rises steeply down the image (1), falls steeply (-1), or neither (0).

    prior: (H, W) float32, px, NaN = unknown. Returns (H, W) int8, with columns of 0 up to a multiple of `WORD`.
    """
    height, columns = prior.shape
    slope = np.zeros((height, -(-columns // WORD) * WORD), np.int8)
    rise = prior[2 * SLOPE_REACH :] - prior[: -2 * SLOPE_REACH]
    rises, falls = (rise > MIN_RISE) & (rise <= MAX_RISE), (rise < -MIN_RISE) & (rise >= -MAX_RISE)
    np.subtract(rises, falls, out=slope[SLOPE_REACH:-SLOPE_REACH, :columns], dtype=np.int8)
    return slope


@part
def smoothed_costs(inputs, unseen_cost, first_lane, ahead, column_sums, costs, width):
    """The costs of the row before row `ahead` of a sweep, all pixels and disparities: costs (W * n,) uint8.

    first_lane: the disparity of the first lane, less the smallest searched; ahead:
    may be one row outside the image, whose border then counts twice; column_sums: (2, W * n) uint8, those of the two
    rows before `ahead`; the sums of `ahead` replace the older ones.
    """
    n = lanes_in(width)
    columns = costs.size // n
    older, newer = column_sums[ahead & 1], column_sums[1 - (ahead & 1)]
    inside = min(max(ahead, 0), inputs.left.shape[0] - 1)
    left, right = inputs.left[inside], inputs.right[inside]
    nothing = broadcast(0, width)
    before = here = nothing
    for x in range(-1, columns):
        beside = min(x + 1, columns - 1)
        after = raw_costs(left, right, inputs, unseen_cost, beside, columns - 1 - beside + first_lane, width)
        if x < 0:  # the border pixel counts twice
            before = here = after
            continue
        three = plus(plus(before, here), after)
        mean = average(average(load(older, x * n, width), three), load(newer, x * n, width))
        store(older, x * n, three)
        store(costs, x * n, average(average(mean, nothing), nothing))
        before, here = here, after


@part
def set_aside(slope, step, behind, spare, width):
    """Copy what `follow_slope` needs of the row behind row y of a sweep, before `smoothed_costs` overwrites its sums.

    slope: of row y; step: 1 for a sweep down, -1 for a sweep up; behind, spare: (W * n,) uint8.
    """
    n, words = lanes_in(width), slope.view(np.int64)
    for i in range(words.size):
        if words[i] != 0:
            for x in range(WORD * i, WORD * (i + 1)):
                if slope[x] != 0:
                    store(spare, x * n, _moved(load(behind, x * n, width), step * slope[x]))


@part
def follow_slope(slope, step, spare, ahead, middle, costs, width):
    """Smooth the costs of row y again where it is steep; ahead, middle: column sums of the next row and of row y."""
    nothing, n, words = broadcast(0, width), lanes_in(width), slope.view(np.int64)
    for i in range(words.size):
        if words[i] != 0:
            for x in range(WORD * i, WORD * (i + 1)):
                if slope[x] != 0:
                    ends = average(load(spare, x * n, width), _moved(load(ahead, x * n, width), -step * slope[x]))
                    mean = average(ends, load(middle, x * n, width))
                    store(costs, x * n, average(average(mean, nothing), nothing))


@part
def _moved(lanes, rise):
    """The costs of a row, a row away from where disparities are `rise` (1 or -1) px larger, at its disparities."""
    return shifted(lanes, NOT_SEARCHED, 1) if rise > 0 else shifted(lanes, NOT_SEARCHED, -1)


@part
def raw_costs(left, right, inputs, unseen_cost, x, i, width):
    """The costs of pixel x of a row at each disparity, not smoothed.

    left, right: planes of the row in `inputs`; i: the index in `right` of the partner at the first disparity, which the
    other partners follow; unseen_cost: the cost of partners outside the image.
    """
    bits = differing_bits(left, right, x, i, width)
    dx = difference(broadcast(byte(left[DX], x), width), load(right[DX], i, width))
    dy = difference(broadcast(byte(left[DY], x), width), load(right[DY], i, width))
    step = lesser(plus_capped(dx, dy), broadcast(MAX_GRADIENT_DIFFERENCE, width))
    twice = plus(step, step)
    cost = plus(plus(plus(bits, bits), step), plus(twice, twice))
    if inputs.in_view_from <= i < inputs.in_view_to:
        return cost
    outside = load(inputs.outside, i, width)
    return bit_or(minus_capped(cost, outside), bit_and(outside, broadcast(unseen_cost, width)))


def raw_costs_reference(left: Array, right: Array, partner: Array, unseen_cost: int) -> Array:
    """The costs of pixels at some partners, not smoothed, (H, W, n) int64, in plain numpy.

    left, right: (H, 5, W) uint8, not mirrored; partner: (H, W, n), columns, which may be outside the right image.
    """
    columns = right.shape[2]
    inside = (partner >= 0) & (partner < columns)
    rows = np.arange(len(right))[:, np.newaxis, np.newaxis]
    there = right.transpose(1, 0, 2)[:, rows, np.where(inside, partner, 0)]
    here = left.transpose(1, 0, 2)[..., np.newaxis]
    bits = np.bitwise_count(here[:DX] ^ there[:DX]).sum(axis=0, dtype=np.int64)
    step = np.abs(here[DX:].astype(int) - there[DX:]).sum(axis=0)
    return np.where(inside, 2 * bits + 5 * np.minimum(step, MAX_GRADIENT_DIFFERENCE), unseen_cost)


def smoothed_reference(raw: Array, searched: Array, slope: Array, beyond: int) -> Array:
    """Means of raw costs (H, W, n) over 3x3 pixels, along the slope (H, W), in plain numpy.

    searched: (H, W, n) bool; a pixel's own cost stands in for neighbours that were not. beyond: the cost of a neighbour
    beyond either end of the range, or -1, which counts as not searched.
    """

    def neighbours(costs: Array, axis: int) -> tuple[Array, Array]:
        pad = [(int(axis == k),) * 2 for k in range(3)]
        wide = np.where(np.pad(searched, pad, mode="edge"), np.pad(costs, pad, mode="edge"), -1)
        length = costs.shape[axis]
        pair = wide.take(range(length), axis), wide.take(range(2, length + 2), axis)
        if axis == 0:
            for y, x in zip(*np.nonzero(slope), strict=True):
                for row, later in zip(pair, (slope[y, x], -slope[y, x]), strict=True):
                    row[y, x] = np.pad(row[y, x], 1, constant_values=beyond)[1 - later :][: raw.shape[2]]
        one, other = (np.where(row < 0, costs, row) for row in pair)
        return one, other

    west, east = neighbours(raw, 1)
    three = west + raw + east
    up, down = neighbours(three, 0)
    mean = ((up + down + 1) // 2 + three + 1) // 2
    return np.where(searched, ((mean + 1) // 2 + 1) // 2, NOT_SEARCHED)


def smoothed_costs_reference(
    left: Array, right: Array, lanes: int, minimum: int, unseen_cost: int, slope: Array | None = None
) -> Array:
    """All costs, (H, W, lanes) uint8, in plain numpy. left, right: (H, 5, W) uint8, not mirrored."""
    height, _, columns = left.shape
    partner = np.arange(columns)[:, np.newaxis] - minimum - np.arange(lanes)
    raw = raw_costs_reference(left, right, np.broadcast_to(partner, (height, *partner.shape)), unseen_cost)
    slope = np.zeros((height, columns), np.int8) if slope is None else slope
    return smoothed_reference(raw, np.ones(raw.shape, bool), slope, NOT_SEARCHED).astype(np.uint8)
