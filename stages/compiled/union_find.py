"""Union-find over indices: the root of a set is its smallest index.

parent: (n,) integers, the parent of each index; a root is its own parent. Path halving (Tarjan and van Leeuwen, 1984)
keeps the paths short without ranks.
"""

from __future__ import annotations

from stages.compiled.jit import part


@part
def root(parent, i):
    """The root of `i`."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@part
def join(parent, one, other):
    """Join the sets of two indices; the smaller root becomes the root of both."""
    one, other = root(parent, one), root(parent, other)
    if one < other:
        parent[other] = one
    else:
        parent[one] = other
