"""Semi-global aggregation (Hirschmüller, 2008, section 2.3): the cost of the cheapest paths that lead to each pixel.

    L(p, d) = C(p, d) + min(L(q, d), L(q, d - 1) + p1, L(q, d + 1) + p1, p2) - min over d of the sum before it

with q the pixel before p on the path. A sweep down the image follows the 4 paths whose q is to the left or above, a
sweep up the other 4. p2 falls with the step of brightness from q to p, because surfaces are likely to end there.

Three tricks. The smallest value of L is subtracted as soon as it is known, so L never exceeds C + p2 and fits a byte;
costs with a prior stop at 255. Hirschmüller subtracts the same number one pixel later. The 4 paths of a sweep are added
in one pass, each above its own smallest value; sums stop at 255, which no disparity that can win reaches. A diagonal
path keeps its place in memory: x - y (or x + y) is the same for p and q. So one row of costs for each direction is
enough, read and overwritten in place.
"""

from __future__ import annotations

import cv2
import numpy as np

from stages.compiled.jit import part
from stages.compiled.simd import (
    above_smallest,
    broadcast,
    byte,
    lanes_in,
    lesser,
    load,
    plus_capped,
    shifted,
    shifted_in_memory,
    store,
)  # fmt: skip
from stages.data import Array
from stages.matching.kernels.sgm_params import SgmParams

ALIGNMENT = 64
NOT_SEARCHED = 255  # cost beyond either end of the search range
PREDECESSORS = ((0, -1), (-1, -1), (-1, 0), (-1, 1))  # (dy, dx) to q in a sweep down; their opposites in a sweep up


def brightness_steps(image: Array) -> Array:
    """Absolute differences to the four neighbours of `PREDECESSORS`.

    image: (H, W) uint8. Returns (4, H + 1, S) uint8 with S >= W + 2: pixel (y, x) is at [:, y, x + 1], differences to
    pixels outside the image are arbitrary.
    """
    height, columns = image.shape
    stride = -(-(columns + 2) // ALIGNMENT) * ALIGNMENT
    padded = cv2.copyMakeBorder(image, 1, 1, 2, 1 + stride - columns, cv2.BORDER_REPLICATE)
    steps = np.empty((len(PREDECESSORS), height + 1, stride), np.uint8)
    here = np.s_[1 : height + 2, 1 : stride + 1]
    for (dy, dx), step in zip(PREDECESSORS, steps, strict=True):
        cv2.absdiff(padded[here], padded[1 + dy : height + 2 + dy, 1 + dx : stride + 1 + dx], dst=step)
    return steps


@part
def aggregate_row(inputs, params, costs, paths, y, step, sums, place, total, final, width):
    """Continue the paths of one sweep from the row before into row y, and add them up.

    costs: (W * n,) uint8, C of the row without the prior's costs; paths: (3 * W * n,) uint8, L of the row before, 0
    before the first row, updated; step: 1 for a sweep down, -1 for a sweep up; sums: uint8, receives the sums of the
    row from `place` on (W * n); final: the sums of the other sweep are there, and `total` receives all.
    """
    n = lanes_in(width)
    columns = costs.size // n
    _, rows, stride = inputs.steps.shape
    steps, table = inputs.steps.reshape(-1), params.p2_table  # p2 is in the table, for each step of brightness
    nothing, small_step = broadcast(0, width), broadcast(params.p1, width)
    first, last = (0, columns - 1) if step > 0 else (columns - 1, 0)
    upwards = 1 if step < 0 else 0  # the pair (p, q) of a sweep up is the pair (q, p) of a sweep down
    beside = y * stride + first + 1 + upwards
    falling = (rows + y + upwards) * stride + first + 1 + upwards
    upright = (2 * rows + y + upwards) * stride + first + 1
    rising = (3 * rows + y + upwards) * stride + first + 1 - upwards
    fall, rise = (first - y) % columns, (first + y) % columns  # places of the diagonals through the first pixel
    store(paths, fall * n, nothing)  # this path begins here, and the other one at the other end of the row
    store(paths, (2 * columns + (last + y) % columns) * n, nothing)
    path = nothing
    pulled = inputs.prior.size > 0
    begin = inputs.prior[y if pulled else 0]
    x = first
    for _ in range(columns):
        cost = load(costs, x * n, width)
        if pulled:
            cost = plus_capped(cost, load(inputs.prior_costs, begin[x], width))
        path = _continued(path, cost, small_step, byte(table, byte(steps, beside)), width)
        p2 = byte(table, byte(steps, upright))
        total_here = plus_capped(path, _follow(paths, (columns + x) * n, cost, small_step, p2, width))
        if params.diagonals:
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
        fall, rise = _wrapped(fall + step, columns), _wrapped(rise + step, columns)


@part
def _continued(path, cost, p1, p2, width):
    """L of the next pixel of the path `path`, above its smallest value."""
    near = lesser(shifted(path, NOT_SEARCHED, 1), shifted(path, NOT_SEARCHED, -1))
    return next_path(path, near, cost, p1, p2, width)


@part
def _follow(paths, at, cost, p1, p2, width):
    """`_continued` of a path in `paths`, which is overwritten."""
    path = load(paths, at, width)
    near = lesser(
        shifted_in_memory(path, paths, at, NOT_SEARCHED, 1), shifted_in_memory(path, paths, at, NOT_SEARCHED, -1)
    )
    moved = next_path(path, near, cost, p1, p2, width)
    store(paths, at, moved)
    return moved


@part
def next_path(path, near, cost, p1, p2, width):
    """L of the next pixel above its smallest value. path, near: L before, and the lesser of its neighbours."""
    return above_smallest(plus_capped(cost, lesser(lesser(plus_capped(near, p1), path), broadcast(p2, width))))


@part
def _wrapped(place, columns):
    """`place` modulo `columns`, for a place at most one step outside."""
    return 0 if place == columns else columns - 1 if place < 0 else place


def aggregate_reference(
    steps: Array, params: SgmParams, costs: Array, searched: Array, sign: int, beside: bool = True
) -> Array:
    """The sums of the sweep down (sign 1) or up (-1) in plain numpy, (H, W, n) int64.

    steps: of `brightness_steps`; costs: (H, W, n); searched: (H, W, n) bool, the disparities searched at each pixel;
    beside: whether disparities of the pixel before count that are next to the searched ones, but not among them.
    """
    height, columns, n = costs.shape
    total = np.zeros(costs.shape, np.int64)
    for side, (dy, dx) in enumerate(PREDECESSORS):
        if side % 2 and not params.diagonals:
            continue
        dy, dx = sign * dy, sign * dx
        before = np.zeros((height + 2, columns + 2, n + 2), np.int64)  # with a border of paths that begin
        before[1:-1, 1:-1] = NOT_SEARCHED
        for y in range(height)[::sign]:
            for x in range(columns)[::sign]:
                q, own = before[y + dy + 1, x + dx + 1], searched[y, x]
                q = q if beside else np.where(np.pad(own, 1), q, NOT_SEARCHED)
                up, left = (y, x) if sign > 0 else (y + dy, x + dx)
                p2 = params.p2_table[steps[side, up, left + 1]]
                near = np.minimum(np.minimum(q[:-2], q[2:]) + params.p1, np.minimum(q[1:-1], p2))
                after = np.minimum(costs[y, x] + near, 255)
                before[y + 1, x + 1, 1:-1][own] = after[own] - after[own].min()
        total += before[1:-1, 1:-1, 1:-1]
    return np.minimum(total, 255)
