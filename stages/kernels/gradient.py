"""The default matching cost: census and gradient difference of the pixels, smoothed over 3x3.

raw = 2 * (census bits that differ, 0..24) + 5 * min(|difference of dx| + |difference of dy|, 6)
Census tells textured patches apart whatever the exposure; the truncated gradient difference adds what census throws
away, how much darker. The sum over 3 columns (at most 234) and the binomial mean (1, 2, 1) over 3 rows fit a byte. The
trick: only column sums of the two rows passed last are kept, and the next row's are made as the sweep reaches them, so
that no cost is ever stored for the whole image.
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit

from stages.data import Array
from stages.kernels.vectors import (
    Width, average, both, byte, either, exclusive_or, greater, lanes_in, lesser, load, minus, minus_capped, ones, plus,
    plus_capped, spread, store,
)  # fmt: skip

PLANES = 2
BLOCK = 64
LARGEST = 6


def gradients(image: Array, mirrored: bool = False) -> Array:
    """dx, dy (H, 2, W')"""
    height, width = image.shape
    padded_width = -(-width // BLOCK) * BLOCK
    padded = cv2.copyMakeBorder(image, 1, 1, 1, 1 + padded_width - width, cv2.BORDER_REPLICATE)
    result = np.empty((height, PLANES, padded_width), np.uint8)
    _gradients(padded.reshape(-1), padded.shape[1], -1 if mirrored else 1, result.reshape(-1), height, padded_width, Width(BLOCK))
    return result


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _signed(more, less, width):
    return minus_capped(plus_capped(spread(128, width), minus_capped(more, less)), minus_capped(less, more))


@njit(nogil=True, cache=True, error_model="numpy")
def _gradients(image, stride, sign, result, height, columns, width):  # type: ignore[no-untyped-def]
    for y in range(height):
        for x in range(0, columns, lanes_in(width)):
            at = (y + 1) * stride + x + 1
            nw = load(image, at - stride - sign, width)
            n = load(image, at - stride, width)
            ne = load(image, at - stride + sign, width)
            w = load(image, at - sign, width)
            e = load(image, at + sign, width)
            sw = load(image, at + stride - sign, width)
            s = load(image, at + stride, width)
            se = load(image, at + stride + sign, width)
            east = average(average(ne, se), e)
            west = average(average(nw, sw), w)
            north = average(average(nw, ne), n)
            south = average(average(sw, se), s)
            store(result, 2 * y * columns + x, _signed(east, west, width))
            store(result, (2 * y + 1) * columns + x, _signed(south, north, width))


@njit(nogil=True, cache=True, error_model="numpy")
def _raw(left, right, view, columns, x, width):
    i = columns - 1 - x
    bits = ones(exclusive_or(spread(byte(left[0], x), width), load(right[0], i, width)))
    bits = plus(bits, ones(exclusive_or(spread(byte(left[1], x), width), load(right[1], i, width))))
    bits = plus(bits, ones(exclusive_or(spread(byte(left[2], x), width), load(right[2], i, width))))
    a, b = spread(byte(left[3], x), width), load(right[3], i, width)
    dx = either(minus_capped(a, b), minus_capped(b, a))
    a, b = spread(byte(left[4], x), width), load(right[4], i, width)
    dy = either(minus_capped(a, b), minus_capped(b, a))
    step = lesser(plus_capped(dx, dy), spread(LARGEST, width))
    two = plus(step, step)
    cost = plus(plus(plus(bits, bits), step), plus(two, two))
    if x < view.whole_from or x >= view.whole_to:
        outside = load(view.outside, i, width)
        cost = either(minus_capped(cost, outside), both(outside, spread(view.unseen, width)))
    return cost


@njit(nogil=True, cache=True, error_model="numpy")
def smoothed_costs(left, right, view, sums, behind, here, make, costs, width):
    """left right: of the row ahead. sums: (2, W * n): behind, here; behind is replaced by those of the row ahead"""
    n = lanes_in(width)
    columns = costs.size // n
    nothing = spread(0, width)
    behind_row, here_row = sums[behind], sums[here]
    middle = _raw(left, right, view, columns, 0, width)
    before = middle
    for x in range(columns):
        after = _raw(left, right, view, columns, min(x + 1, columns - 1), width)
        ahead = plus(plus(before, middle), after)
        at = x * n
        cost = average(average(load(behind_row, at, width), ahead), load(here_row, at, width))
        store(behind_row, at, ahead)
        store(costs, at, average(average(cost, nothing), nothing))
        before = middle
        middle = after
