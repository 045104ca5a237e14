"""For each binary descriptor its two nearest others, by the number of bits that differ, compared with all of them.

The trick is the layout: the others are kept as planes, the first bytes of all, then the second bytes, and so on. So 64
distances are 32 times one load, one exclusive or, one count of bits and one sum, and each of the 64 lanes remembers the
best it has met. OpenCV's matcher, which it equals, takes many times as long.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel
from stages.compiled.simd import (
    Width,
    byte,
    either,
    exclusive_or,
    greater,
    lanes_in,
    lesser,
    load,
    ones,
    plus,
    plus_capped,
    spread,
    store,
    where_less,
)  # fmt: skip
from stages.data import Array

BYTES = 32  # of a descriptor
BLOCK = 64  # descriptors compared at a time
MOST = 255 * BLOCK


def clear_partners(codes: Array, others: Array, alike: int, distinct: float) -> tuple[Array, Array]:
    """Which of `codes`, (N, 32) uint8, have a partner among `others`, (M, 32) uint8, and which, indices (n,) each.

    A partner differs by at most `alike` bits, and by less than `distinct` times as many as the next best (Lowe, 2004).
    Of more than `MOST` others the first are asked: a detector gives so many only of patterns, where all look alike.
    """
    others = others[:MOST]
    if len(codes) == 0 or len(others) < 2:
        return np.empty(0, np.intp), np.empty(0, np.intp)
    index, best, second = nearest_two(codes, others)
    kept = np.flatnonzero((best <= alike) & (best < distinct * second))
    return kept, index[kept].astype(np.intp)


def nearest_two(codes: Array, others: Array) -> tuple[Array, Array, Array]:
    """The nearest of `others`, (M, 32) uint8, 2 <= M <= 16320, to each of `codes`, (N, 32) uint8.

    Returns its index, of equally near ones the first, (N,) int32; by how many bits it differs, (N,) int32; and by how
    many the next best does, (N,) int32. 256 differing bits count as 255.
    """
    if not 2 <= len(others) <= MOST:
        raise ValueError(f"nearest_two compares with 2 to {MOST} descriptors, not {len(others)}")
    columns = -(-len(others) // BLOCK) * BLOCK
    planes, outside = np.zeros((BYTES, columns), np.uint8), np.full(columns, 255, np.uint8)
    planes[:, : len(others)] = others.T
    outside[: len(others)] = 0
    index, best, second = (np.empty(len(codes), np.int32) for _ in range(3))
    _nearest_two(np.ascontiguousarray(codes), planes, outside, index, best, second, Width(BLOCK))
    return index, best, second


@kernel
def _nearest_two(codes, planes, outside, index, best, second, width):
    lanes = lanes_in(width)
    firsts, nexts, blocks = (np.empty(lanes, np.uint8), np.empty(lanes, np.uint8), np.empty(lanes, np.uint8))
    for i in range(codes.shape[0]):
        code = codes[i]
        first, following, block = spread(255, width), spread(255, width), spread(0, width)
        for x in range(0, outside.size, lanes):
            bits = load(outside, x, width)
            differ = ones(exclusive_or(spread(byte(code, 0), width), load(planes[0], x, width)))
            for k in range(1, BYTES - 1):
                differ = plus(differ, ones(exclusive_or(spread(byte(code, k), width), load(planes[k], x, width))))
            last = ones(exclusive_or(spread(byte(code, BYTES - 1), width), load(planes[BYTES - 1], x, width)))
            bits = either(bits, plus_capped(differ, last))
            block = where_less(bits, first, spread(x // lanes, width), block)
            following = lesser(following, greater(first, bits))
            first = lesser(first, bits)
        store(firsts, 0, first)
        store(nexts, 0, following)
        store(blocks, 0, block)
        least, then, where = np.int64(256), np.int64(256), np.int64(-1)
        for lane in range(lanes):
            here, at = np.int64(firsts[lane]), np.int64(blocks[lane]) * lanes + lane
            if here < least or (here == least and at < where):
                least, then, where = here, min(least, np.int64(nexts[lane])), at
            else:
                then = min(then, here)
        index[i], best[i], second[i] = where, least, then


def nearest_two_reference(codes: Array, others: Array) -> tuple[Array, Array, Array]:
    """The same as `nearest_two`, in plain numpy."""
    differ = np.bitwise_count(codes[:, None] ^ others[None]).sum(axis=2, dtype=np.int32)
    order = np.argsort(differ, axis=1, kind="stable")[:, :2]
    best, second = np.minimum(np.take_along_axis(differ, order, axis=1), 255).T
    return order[:, 0].astype(np.int32), best, second
