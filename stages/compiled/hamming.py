"""The two nearest neighbours of binary descriptors by Hamming distance, by comparison with all others.

The trick is the layout: the others are kept as planes, the first bytes of all, then the second bytes, and so on. So 64
distances take 32 times one load, one exclusive or, one count of bits and one sum, and each of the 64 lanes keeps its
best. The result equals OpenCV's matcher, which takes many times as long.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel
from stages.compiled.simd import (
    Width,
    bit_or,
    bit_xor,
    broadcast,
    byte,
    count_ones,
    greater,
    lanes_in,
    lesser,
    load,
    plus,
    plus_capped,
    store,
    where_less,
)  # fmt: skip
from stages.data import Array

BYTES = 32  # of a descriptor
LANES = 64  # descriptors compared at a time
MAX_OTHERS = 255 * LANES


def clear_partners(codes: Array, others: Array, max_bits: int, max_ratio: float) -> tuple[Array, Array]:
    """Unambiguous pairs of `codes`, (N, 32) uint8, and `others`, (M, 32) uint8: indices into both, (n,) each.

    A pair differs by at most `max_bits` bits, and by less than `max_ratio` times the next best (Lowe, 2004). Only the
    first `MAX_OTHERS` others are compared: a detector finds more only in repeated patterns.
    """
    others = others[:MAX_OTHERS]
    if len(codes) == 0 or len(others) < 2:
        return np.empty(0, np.intp), np.empty(0, np.intp)
    index, best, second = nearest_two(codes, others)
    kept = np.flatnonzero((best <= max_bits) & (best < max_ratio * second))
    return kept, index[kept].astype(np.intp)


def nearest_two(codes: Array, others: Array) -> tuple[Array, Array, Array]:
    """The nearest of `others`, (M, 32) uint8, 2 <= M <= 16320, to each of `codes`, (N, 32) uint8.

    Returns its index (the first of equals), its Hamming distance and that of the next best, (N,) int32 each. A distance
    of 256 counts as 255.
    """
    columns = -(-len(others) // LANES) * LANES
    planes, outside = np.zeros((BYTES, columns), np.uint8), np.full(columns, 255, np.uint8)
    planes[:, : len(others)] = others.T
    outside[: len(others)] = 0
    index, best, second = (np.empty(len(codes), np.int32) for _ in range(3))
    _nearest_two(np.ascontiguousarray(codes), planes, outside, index, best, second, Width(LANES))
    return index, best, second


@kernel
def _nearest_two(codes, planes, outside, index, best, second, width):
    lanes = lanes_in(width)
    firsts, nexts, blocks = (np.empty(lanes, np.uint8), np.empty(lanes, np.uint8), np.empty(lanes, np.uint8))
    for i in range(codes.shape[0]):
        code = codes[i]
        first, following, block = broadcast(255, width), broadcast(255, width), broadcast(0, width)
        for x in range(0, outside.size, lanes):
            bits = load(outside, x, width)
            differ = count_ones(bit_xor(broadcast(byte(code, 0), width), load(planes[0], x, width)))
            for k in range(1, BYTES - 1):
                differ = plus(differ, count_ones(bit_xor(broadcast(byte(code, k), width), load(planes[k], x, width))))
            last = count_ones(bit_xor(broadcast(byte(code, BYTES - 1), width), load(planes[BYTES - 1], x, width)))
            bits = bit_or(bits, plus_capped(differ, last))
            block = where_less(bits, first, broadcast(x // lanes, width), block)
            following = lesser(following, greater(first, bits))
            first = lesser(first, bits)
        store(firsts, 0, first)
        store(nexts, 0, following)
        store(blocks, 0, block)
        nearest, next_nearest, place = np.int64(256), np.int64(256), np.int64(-1)
        for lane in range(lanes):
            here, at = np.int64(firsts[lane]), np.int64(blocks[lane]) * lanes + lane
            if here < nearest or (here == nearest and at < place):
                nearest, next_nearest, place = here, min(nearest, np.int64(nexts[lane])), at
            else:
                next_nearest = min(next_nearest, here)
        index[i], best[i], second[i] = place, nearest, next_nearest


def nearest_two_reference(codes: Array, others: Array) -> tuple[Array, Array, Array]:
    """The same as `nearest_two`, in plain numpy."""
    differ = np.bitwise_count(codes[:, None] ^ others[None]).sum(axis=2, dtype=np.int32)
    order = np.argsort(differ, axis=1, kind="stable")[:, :2]
    best, second = np.minimum(np.take_along_axis(differ, order, axis=1), 255).T
    return order[:, 0].astype(np.int32), best, second
