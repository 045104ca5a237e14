"""Semi-global aggregation (Hirschmüller, 2008, section 2.3): the cost of the cheapest paths that lead to each pixel.

    L(p, d) = C(p, d) + min(L(q, d), L(q, d - 1) + p1, L(q, d + 1) + p1, p2) - min over d of the sum before it

with q the pixel before p on the path. Paths come from 8 sides: a sweep down the image follows the 4 whose q is to the
left or above, a sweep up the other 4. p2 falls with the step of brightness from q to p, where surfaces are likely to
end.

Three tricks. L has its smallest value subtracted as soon as it is known, so that it never exceeds C + p2 and fits a
byte (what a prior makes dearer than that stops at 255); Hirschmüller subtracts the same number one pixel later. The 4
paths of a sweep are added where they stand, in one pass, as numbers above their own smallest; sums stop at 255, which
no disparity that might win reaches. And a path along a diagonal keeps its place in memory: its place is x - y (or
x + y), which is the same for p and q, so that one row of costs for each direction is enough, read and overwritten in
place.
"""

from __future__ import annotations

import cv2
import numpy as np

from stages.compiled.jit import part
from stages.compiled.simd import (
    above_smallest,
    byte,
    lanes_in,
    lesser,
    load,
    plus_capped,
    shifted,
    shifted_in_memory,
    spread,
    store,
)  # fmt: skip
from stages.data import Array
from stages.matching.kernels.census import census_costs
from stages.matching.kernels.sgm_params import SgmParams

BLOCK = 64
FAR = 255  # beyond either end of the search range
SIDES = ((0, -1), (-1, -1), (-1, 0), (-1, 1))  # (dy, dx) to q of a sweep down; of a sweep up their opposites


def brightness_steps(image: Array) -> Array:
    """Absolute differences to the four neighbours of `SIDES`.

    image: (H, W) uint8. Returns (4, H + 1, S) uint8 with S >= W + 2: pixel (y, x) is at [:, y, x + 1], differences to
    pixels outside the image are arbitrary.
    """
    height, columns = image.shape
    stride = -(-(columns + 2) // BLOCK) * BLOCK
    padded = cv2.copyMakeBorder(image, 1, 1, 2, 1 + stride - columns, cv2.BORDER_REPLICATE)
    steps = np.empty((len(SIDES), height + 1, stride), np.uint8)
    here = np.s_[1 : height + 2, 1 : stride + 1]
    for (dy, dx), step in zip(SIDES, steps, strict=True):
        cv2.absdiff(padded[here], padded[1 + dy : height + 2 + dy, 1 + dx : stride + 1 + dx], dst=step)
    return steps


@part
def aggregate_row(pair, rule, first_lane, costs, paths, y, step, sums, place, total, final, width):
    """Follow the paths of one sweep from the row before into row y, and add them up.

    pair, rule: `pair.MatchingInputs` and `SgmParams`; first_lane: the disparity of the first lane, less the smallest
    searched; costs: (W * n,) uint8, C of the row without the prior's costs, with `rule.gradient`; else C is the census
    cost, made here, which saves writing and reading it; paths: (3 * W * n,) uint8, L of the row before, all 0 at
    first, updated; step: 1 for a sweep down, -1 for a sweep up; sums: uint8, where the sums of the row go, from
    `place` on (W * n); final: instead, add what the other sweep left there, and put the whole into `total`.
    """
    n = lanes_in(width)
    columns = costs.size // n
    _, rows, stride = pair.steps.shape
    steps, table = pair.steps.reshape(-1), rule.table  # p2 is in the table, for each step of brightness
    nothing, small_step = spread(0, width), spread(rule.p1, width)
    first, last = (0, columns - 1) if step > 0 else (columns - 1, 0)
    upwards = 1 if step < 0 else 0  # the pair (p, q) of a sweep up is the pair (q, p) of a sweep down
    beside = y * stride + first + 1 + upwards
    falling = (rows + y + upwards) * stride + first + 1 + upwards
    upright = (2 * rows + y + upwards) * stride + first + 1
    rising = (3 * rows + y + upwards) * stride + first + 1 - upwards
    fall, rise = (first - y) % columns, (first + y) % columns  # places of the diagonals through the first pixel
    store(paths, fall * n, nothing)  # this path begins here, as does the one at the other end of the row
    store(paths, (2 * columns + (last + y) % columns) * n, nothing)
    path = nothing
    left, right = pair.left[y], pair.right[y]
    pulled = pair.prior.size > 0
    begin = pair.prior[y if pulled else 0]
    x = first
    for _ in range(columns):
        if rule.gradient:
            cost = load(costs, x * n, width)
        else:
            cost = census_costs(left, right, pair, rule.unseen, x, columns - 1 - x + first_lane, width)
        if pulled:
            cost = plus_capped(cost, load(pair.prior_costs, begin[x], width))
        path = _continued(path, cost, small_step, byte(table, byte(steps, beside)), width)
        p2 = byte(table, byte(steps, upright))
        total_here = plus_capped(path, _follow(paths, (columns + x) * n, cost, small_step, p2, width))
        if rule.diagonals:
            p2 = byte(table, byte(steps, falling))
            total_here = plus_capped(total_here, _follow(paths, fall * n, cost, small_step, p2, width))
            p2 = byte(table, byte(steps, rising))
            total_here = plus_capped(total_here, _follow(paths, (2 * columns + rise) * n, cost, small_step, p2, width))
        here = place + x * n
        if final:
            store(total, x * n, plus_capped(total_here, load(sums, here, width)))
        else:
            store(sums, here, total_here)
        beside, falling, upright, rising, x = beside + step, falling + step, upright + step, rising + step, x + step
        fall, rise = _around(fall + step, columns), _around(rise + step, columns)


@part
def _continued(path, cost, p1, p2, width):
    """L of the next pixel of a path that is at hand, above its smallest value."""
    near = lesser(shifted(path, FAR, 1), shifted(path, FAR, -1))
    return next_path(path, near, cost, p1, p2, width)


@part
def _follow(paths, at, cost, p1, p2, width):
    """`_continued` of a path that is kept in `paths`, and is there again."""
    path = load(paths, at, width)
    near = lesser(shifted_in_memory(path, paths, at, FAR, 1), shifted_in_memory(path, paths, at, FAR, -1))
    moved = next_path(path, near, cost, p1, p2, width)
    store(paths, at, moved)
    return moved


@part
def next_path(path, near, cost, p1, p2, width):
    """L of the next pixel above its smallest value. path, near: L before, and the lesser of its neighbours."""
    return above_smallest(plus_capped(cost, lesser(lesser(plus_capped(near, p1), path), spread(p2, width))))


@part
def _around(place, columns):
    """`place` modulo `columns`, from one step outside at most."""
    return 0 if place == columns else columns - 1 if place < 0 else place


def aggregate_reference(
    steps: Array, rule: SgmParams, costs: Array, searched: Array, sign: int, beside: bool = True
) -> Array:
    """The sums of the sweep down (sign 1) or up (-1) in plain numpy, (H, W, n) int64.

    steps: of `brightness_steps`; costs: (H, W, n); searched: (H, W, n) bool, where a pixel looks for disparities;
    beside: whether what only the pixel before has counts where it is next to what is searched.
    """
    height, columns, n = costs.shape
    total = np.zeros(costs.shape, np.int64)
    for side, (dy, dx) in enumerate(SIDES):
        if side % 2 and not rule.diagonals:
            continue
        dy, dx = sign * dy, sign * dx
        before = np.zeros((height + 2, columns + 2, n + 2), np.int64)  # of every pixel, a frame of paths that begin
        before[1:-1, 1:-1] = FAR
        for y in range(height)[::sign]:
            for x in range(columns)[::sign]:
                q, own = before[y + dy + 1, x + dx + 1], searched[y, x]
                q = q if beside else np.where(np.pad(own, 1), q, FAR)
                up, left = (y, x) if sign > 0 else (y + dy, x + dx)
                p2 = rule.table[steps[side, up, left + 1]]
                near = np.minimum(np.minimum(q[:-2], q[2:]) + rule.p1, np.minimum(q[1:-1], p2))
                after = np.minimum(costs[y, x] + near, 255)
                before[y + 1, x + 1, 1:-1][own] = after[own] - after[own].min()
        total += before[1:-1, 1:-1, 1:-1]
    return np.minimum(total, 255)
