"""Union-find over numbered things: the root that a thing hangs from is the first of its set.

parent: (n,) integers, the thing that each hangs from, itself for a root. Paths are halved as they are walked (Tarjan
and van Leeuwen, 1984), which keeps them short without ranks.
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
    """Make one set of those of two things; the earlier root becomes the root of both."""
    one, other = root(parent, one), root(parent, other)
    if one < other:
        parent[other] = one
    else:
        parent[one] = other
