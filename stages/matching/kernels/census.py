"""Census: how many of the 24 comparisons of a pixel with its 5x5 neighbourhood differ between left and right.

(Zabih and Woodfill, 1994.) Each comparison, "is the neighbour darker", is a bit, so the cost does not depend on
exposure and gain. The trick is the layout: the bits are 3 planes of bytes, and the right image is mirrored. Then the
partners of a left pixel, disparity after disparity, are neighbours in memory, and 64 costs take three times one load,
one exclusive or and one count of bits.
"""

from __future__ import annotations

import cv2
import numpy as np

from stages.compiled.jit import kernel, part
from stages.compiled.simd import (
    Width,
    bit_or,
    bit_xor,
    broadcast,
    byte,
    count_ones,
    lanes_in,
    load,
    plus,
    store,
    where_less,
)  # fmt: skip
from stages.data import Array

BITS = 24
PLANES = BITS // 8
OFFSETS = tuple((dy, dx) for dy in range(-2, 3) for dx in range(-2, 3) if (dy, dx) != (0, 0))
LANES = 64  # pixels at a time


def census(image: Array, planes: Array, mirrored: bool = False) -> None:
    """Write the comparisons of each pixel into `planes`.

    image: (H, W) uint8, its own border replicated beyond; planes: (H, at least 3, at least W rounded up to 64) uint8,
    whose first three planes are written, in more than W columns; mirrored: the image is flipped left to right, and the
    bits are those of the image before the flip.
    """
    columns = -(-image.shape[1] // LANES) * LANES
    padded = cv2.copyMakeBorder(image, 2, 2, 2, 2 + columns - image.shape[1], cv2.BORDER_REPLICATE)
    _census(padded, -1 if mirrored else 1, planes, columns, Width(LANES))


@kernel
def _census(image, sign, planes, columns, width):
    nothing, stride = broadcast(0, width), image.shape[1]
    for y in range(planes.shape[0]):
        for x in range(0, columns, lanes_in(width)):
            at = (y + 2) * stride + x + 2
            centre = load(image, at, width)
            bit, plane = 0, nothing
            for dy in range(-2, 3):
                for dx in range(-2, 3):
                    if dy != 0 or dx != 0:
                        neighbour = load(image, at + dy * stride + sign * dx, width)
                        plane = bit_or(plane, where_less(neighbour, centre, broadcast(1 << (bit & 7), width), nothing))
                        bit += 1
                        if bit & 7 == 0:
                            store(planes[y, (bit >> 3) - 1], x, plane)
                            plane = nothing


def census_reference(image: Array, mirrored: bool = False) -> Array:
    """The planes of `census`, (H, 3, W) uint8, in plain numpy."""
    height, width = image.shape
    padded = np.pad(image, 2, mode="edge")
    bits = np.zeros((height, PLANES, width), np.uint8)
    for bit, (dy, dx) in enumerate(OFFSETS):
        neighbour = padded[2 + dy :, 2 + (-dx if mirrored else dx) :][:height, :width]
        bits[:, bit // 8] |= (neighbour < image).astype(np.uint8) << (bit % 8)
    return bits


@part
def differing_bits(left, right, x, i, width):
    """The number of comparisons that differ between pixel x of a row and its partners, from index i of `right` on."""
    bits = count_ones(bit_xor(broadcast(byte(left[0], x), width), load(right[0], i, width)))
    bits = plus(bits, count_ones(bit_xor(broadcast(byte(left[1], x), width), load(right[1], i, width))))
    return plus(bits, count_ones(bit_xor(broadcast(byte(left[2], x), width), load(right[2], i, width))))
