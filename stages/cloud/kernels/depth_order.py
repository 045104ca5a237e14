"""Patches of points that are out of order: up a column of the image the ground recedes.

A line of sight that passes over ground cannot end nearer than one below it, unless something stands there; and what
stands, stands on the ground. So a patch that touches nothing, with what lies below it in the image farther away, hangs
in the air, like what is matched in the sky; and one with what lies above it nearer would have to lie under the ground.
Which of the two is wrong the smaller is taken to be.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array

CLEAR = 1.1  # ratio of depths from which one is the nearer
ROUNDS = 3  # what is out of order may hide that something else is


def out_of_order(inverse: Array, patch: Array) -> Array:
    """Which pixels belong to a patch that is out of order in most of the columns where it meets another.

    inverse: (H, W) float32, inverse depth, 1/m, NaN = no point; patch: (H, W) int32, of `patches.patches`, -1 where
    there is no point. Rows run from the sky down. Returns (H, W) bool.
    """
    patch = patch.copy()
    sizes = np.bincount(patch.ravel() + 1, minlength=patch.size + 1)[1:]
    for _ in range(ROUNDS):
        votes = np.zeros(patch.size, np.int32)
        _vote(inverse, patch, sizes, np.float32(CLEAR), votes)
        if not (votes > 0).any():
            break
        _drop(patch.reshape(-1), votes)
    gone: Array = (patch < 0) & (inverse > 0)
    return gone


@kernel
def _vote(inverse, patch, sizes, clear, votes):
    """Add 1 for every column in which a patch is out of order with a larger one, take 1 off where it is not."""
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
            votes[smaller] += 1 if inverse[row, col] > clear * inverse[last, col] else -1


@kernel
def _drop(patch, votes):
    for i in range(patch.size):
        if patch[i] >= 0 and votes[patch[i]] > 0:
            patch[i] = -1


def out_of_order_reference(inverse: Array, patch: Array) -> Array:
    """`out_of_order`, one column after the other in plain numpy."""
    patch = patch.copy()
    sizes = np.bincount(patch[patch >= 0], minlength=patch.size)
    for _ in range(ROUNDS):
        votes = np.zeros(patch.size, np.int64)
        for column, numbers in zip(inverse.T, patch.T, strict=True):
            rows = np.flatnonzero(numbers >= 0)
            for above, under in pairwise(rows):
                one, other = numbers[above], numbers[under]
                if one != other:
                    nearer = column[above] > np.float32(CLEAR) * column[under]
                    votes[one if sizes[one] < sizes[other] else other] += 1 if nearer else -1
        patch[(patch >= 0) & (votes > 0)[patch]] = -1
    gone: Array = (patch < 0) & (inverse > 0)
    return gone
