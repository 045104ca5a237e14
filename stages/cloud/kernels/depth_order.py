"""Floater removal by depth order: up a column of the image the ground recedes.

Objects rest on the ground. An isolated patch that is nearer than the patch below it in the image would hang in the air,
as mismatches in the sky do. A patch that is farther than the patch above it would lie under the ground. If two patches
contradict the depth order, the smaller one is treated as the outlier.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array

MIN_DEPTH_RATIO = 1.1  # between two depths in the wrong order
ROUNDS = 3  # an outlier may hide another one


def out_of_order(inverse: Array, patch: Array, sizes: Array) -> Array:
    """Pixels of the patches that are out of order in most of the columns where they meet another, (H, W) bool.

    inverse: (H, W) float32, inverse depth, 1/m, NaN = no point; patch: (H, W) int32, labels of `connected_patches`;
    sizes: (H * W,) int32, points of each patch. Rows run from the sky down.
    """
    patch = patch.copy()
    for _ in range(ROUNDS):
        votes = np.zeros(patch.size, np.int32)
        _vote(inverse, patch, sizes, np.float32(MIN_DEPTH_RATIO), votes)
        if not (votes > 0).any():
            break
        _drop(patch.reshape(-1), votes)
    gone: Array = (patch < 0) & (inverse > 0)
    return gone


@kernel
def _vote(inverse, patch, sizes, min_ratio, votes):
    """Add 1 for every column in which a patch is out of order with a larger one, else subtract 1."""
    below = np.full(inverse.shape[1], -1, np.int64)
    for row in range(inverse.shape[0] - 1, -1, -1):
        for col in range(inverse.shape[1]):
            here = patch[row, col]
            if here < 0:
                continue
            last = below[col]
            below[col] = row
            if last < 0 or patch[last, col] == here:
                continue
            other = patch[last, col]
            smaller = here if sizes[here] < sizes[other] else other
            votes[smaller] += 1 if inverse[row, col] > min_ratio * inverse[last, col] else -1


@kernel
def _drop(patch, votes):
    for i in range(patch.size):
        if patch[i] >= 0 and votes[patch[i]] > 0:
            patch[i] = -1


def out_of_order_reference(inverse: Array, patch: Array, sizes: Array) -> Array:
    """The same as `out_of_order`, one column at a time, in plain numpy."""
    patch = patch.copy()
    for _ in range(ROUNDS):
        votes = np.zeros(patch.size, np.int64)
        for column, numbers in zip(inverse.T, patch.T, strict=True):
            rows = np.flatnonzero(numbers >= 0)
            for above, under in pairwise(rows):
                one, other = numbers[above], numbers[under]
                if one != other:
                    nearer = column[above] > np.float32(MIN_DEPTH_RATIO) * column[under]
                    votes[one if sizes[one] < sizes[other] else other] += 1 if nearer else -1
        patch[(patch >= 0) & (votes > 0)[patch]] = -1
    gone: Array = (patch < 0) & (inverse > 0)
    return gone
