"""Floater removal by depth order: up a column of the image the ground recedes.

Objects rest on the ground. An isolated patch that is nearer than the patch below it in the image would hang in the air,
as mismatches in the sky do. A patch that is farther than the patch above it would lie under the ground. If two patches
contradict the depth order, the smaller one is treated as the outlier. An overhanging rock is also nearer than the
ground below it, but a larger patch recedes above it: this counts twice.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array

MIN_DEPTH_RATIO = 1.1  # between two depths in the wrong order
ROUNDS = 3  # an outlier may hide another one


def out_of_order(inverse: Array, patch: Array, sizes: Array) -> Array:
    """Patches that are out of order in most of the columns where they meet another, (K,) bool.

    inverse: (H, W) float32, inverse depth, 1/m, NaN = no point; patch: (H, W) int32, labels of `connected_patches`;
    sizes: (K,) int32, points of each patch. Rows run from the sky down.
    """
    gone = np.zeros(len(sizes), np.bool_)
    for _ in range(ROUNDS):
        votes = np.zeros(len(sizes), np.int32)
        _vote(inverse, patch, sizes, gone, np.float32(MIN_DEPTH_RATIO), votes)
        if not (votes > 0).any():
            break
        gone |= votes > 0
    return gone


@kernel
def _vote(inverse, patch, sizes, gone, min_ratio, votes):
    """Add 1 for every column in which a patch is out of order with a larger one, else subtract 1 or, below it, 2."""
    below = np.full(inverse.shape[1], -1, np.int32)  # in each column: the patch of the last point,
    last = np.empty(inverse.shape[1], np.float32)  # and its inverse depth
    for row in range(inverse.shape[0] - 1, -1, -1):
        for col in range(inverse.shape[1]):
            here, other = patch[row, col], below[col]
            if here < 0 or gone[here]:
                continue
            if other >= 0 and other != here:
                nearer = inverse[row, col] > min_ratio * last[col]
                if sizes[here] < sizes[other]:
                    votes[here] += 1 if nearer else -1
                else:
                    votes[other] += 1 if nearer else -2
            below[col], last[col] = here, inverse[row, col]


def out_of_order_reference(inverse: Array, patch: Array, sizes: Array) -> Array:
    """The same as `out_of_order`, one column at a time, in plain numpy."""
    gone = np.zeros(len(sizes), bool)
    for _ in range(ROUNDS):
        votes = np.zeros(len(sizes), np.int64)
        for column, numbers in zip(inverse.T, patch.T, strict=True):
            rows = np.flatnonzero((numbers >= 0) & ~np.append(gone, True)[numbers])
            for above, under in pairwise(rows):
                one, other = numbers[above], numbers[under]
                if one != other:
                    nearer = column[above] > np.float32(MIN_DEPTH_RATIO) * column[under]
                    smaller, in_order = (one, -1) if sizes[one] < sizes[other] else (other, -2)
                    votes[smaller] += 1 if nearer else in_order
        gone |= votes > 0
    return gone
