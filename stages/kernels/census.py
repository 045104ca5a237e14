"""Census cost: how many of the 24 comparisons of a pixel with its 5x5 neighbourhood differ between left and right.

(Zabih and Woodfill, 1994.) Each comparison, "is the neighbour darker", is a bit, so that the cost does not feel a change
of exposure or gain. The trick is the layout. The bits are kept as 3 planes of bytes, and the right image runs backwards:
then the right partners of one left pixel, disparity after disparity, are neighbours in memory, and 64 costs are three
times one load, one exclusive or and one count of bits.
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit

from stages.data import Array
from stages.kernels.vectors import (
    Width, both, byte, either, exclusive_or, lanes_in, load, minus_capped, ones, plus, spread, store, where_less,
)  # fmt: skip

BITS = 24
PLANES = BITS // 8
OFFSETS = tuple((dy, dx) for dy in range(-2, 3) for dx in range(-2, 3) if (dy, dx) != (0, 0))
BLOCK = 64  # pixels described at a time


def census(image: Array, mirrored: bool = False) -> Array:
    """The comparisons of each pixel as bytes.

    image: (H, W) uint8, its own border replicated beyond; mirrored: the image is flipped left to right, and the bits are
    to be those of the image as it was. Returns (H, 3, W') uint8 with W' = W rounded up to 64 (the rest is arbitrary).
    """
    height, width = image.shape
    padded_width = -(-width // BLOCK) * BLOCK
    padded = cv2.copyMakeBorder(image, 2, 2, 2, 2 + padded_width - width, cv2.BORDER_REPLICATE)
    bits = np.empty((height, PLANES, padded_width), np.uint8)
    _census(padded.reshape(-1), padded.shape[1], -1 if mirrored else 1, bits.reshape(-1), height, padded_width, Width(BLOCK))
    return bits


@njit(nogil=True, cache=True, error_model="numpy")
def _census(image, stride, sign, bits, height, columns, width):  # type: ignore[no-untyped-def]
    nothing = spread(0, width)
    for y in range(height):
        for x in range(0, columns, lanes_in(width)):
            at = (y + 2) * stride + x + 2
            centre = load(image, at, width)
            bit = 0
            plane = nothing
            for dy in range(-2, 3):
                for dx in range(-2, 3):
                    if dy == 0 and dx == 0:
                        continue
                    darker = where_less(
                        load(image, at + dy * stride + sign * dx, width), centre, spread(1 << (bit & 7), width), nothing
                    )
                    plane = either(plane, darker)
                    bit += 1
                    if bit & 7 == 0:
                        store(bits, (y * PLANES + (bit >> 3) - 1) * columns + x, plane)
                        plane = nothing


def census_reference(image: Array, mirrored: bool = False) -> Array:
    """`census` in plain numpy, without the arbitrary columns."""
    height, width = image.shape
    padded = np.pad(image, 2, mode="edge")
    bits = np.zeros((height, PLANES, width), np.uint8)
    for bit, (dy, dx) in enumerate(OFFSETS):
        neighbour = padded[2 + dy :, 2 + (-dx if mirrored else dx) :][:height, :width]
        bits[:, bit // 8] |= (neighbour < image).astype(np.uint8) << (bit % 8)
    return bits


@njit(nogil=True, cache=True, error_model="numpy")
def census_costs(left, right, view, costs, width):  # type: ignore[no-untyped-def]
    """The costs of one row, all pixels and disparities.

    left: (3, W) uint8, the row's bits; right: (3, W + n) the right row's, backwards, so that pixel x and lane d meet
    at W - 1 - x + d; view: see `semiglobal.View`; costs: (W * n,) uint8, the result, pixel after pixel.
    """
    n = lanes_in(width)
    columns = costs.size // n
    left0, left1, left2 = left[0], left[1], left[2]
    right0, right1, right2 = right[0], right[1], right[2]
    for x in range(columns):
        i = columns - 1 - x
        cost = ones(exclusive_or(spread(byte(left0, x), width), load(right0, i, width)))
        cost = plus(cost, ones(exclusive_or(spread(byte(left1, x), width), load(right1, i, width))))
        cost = plus(cost, ones(exclusive_or(spread(byte(left2, x), width), load(right2, i, width))))
        if x < view.whole_from or x >= view.whole_to:
            outside = load(view.outside, i, width)
            cost = either(minus_capped(cost, outside), both(outside, spread(view.unseen, width)))
        store(costs, x * n, cost)
