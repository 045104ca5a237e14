from __future__ import annotations
from typing import NamedTuple
import numpy as np
from numba import njit
from stages.data import Array
from stages.kernels.aggregation import aggregate_row
from stages.kernels.census import census_costs
from stages.kernels.gradient import smoothed_costs
from stages.kernels.selection import find_winners, fit_row
from stages.kernels.vectors import Width, lanes_in, load, plus_capped, store

class View(NamedTuple):
    outside: Array
    unseen: int
    whole_from: int
    whole_to: int

class Pair(NamedTuple):
    left: Array   # (H, planes, W')
    right: Array
    penalties: Array
    prior: Array  # (H, W) int32 or (0, 0)
    prior_costs: Array

class Rule(NamedTuple):
    gradient: bool
    diagonals: bool
    p1: int
    disparities: int
    minimum: int
    keep: int
    tolerance: int

class Scratch(NamedTuple):
    costs: Array
    column_sums: Array
    state: Array
    total: Array
    winner: Array
    evidence: Array
    right: Array
    beyond: Array
    guard: Array

@njit(nogil=True, error_model="numpy", cache=True)
def sweep(pair, view, rule, scratch, state, y0, y1, step, sums, origin, final, pixels, strength, width):
    """Rows y0 to y1 (exclusive). sums: (rows * W * n,), row y at (y - origin) * W * n."""
    height = pair.left.shape[0]
    columns = pixels.shape[1]
    row_size = columns * lanes_in(width)
    if rule.gradient:
        for y in (y0 - step, y0):
            ahead = min(max(y, 0), height - 1)
            smoothed_costs(pair.left[ahead], pair.right[ahead], view, scratch.column_sums, y & 1, 1 - (y & 1), True, scratch.costs, width)
    y = y0
    while y != y1:
        if rule.gradient:
            ahead = min(max(y + step, 0), height - 1)
            smoothed_costs(pair.left[ahead], pair.right[ahead], view, scratch.column_sums, (y + 1) & 1, y & 1, True, scratch.costs, width)
        else:
            census_costs(pair.left[y], pair.right[y], view, scratch.costs, width)
        if pair.prior.size > 0:
            add_prior(scratch.costs, pair.prior[y], pair.prior_costs, width)
        aggregate_row(scratch.costs, pair.penalties, state, y, step, rule.p1, rule.diagonals, sums, (y - origin) * row_size, scratch.total, final, width)
        if final:
            find_winners(scratch.total, scratch.beyond, scratch.guard, step, scratch.winner, scratch.evidence, scratch.right, width)
            fit_row(scratch.winner, scratch.evidence, scratch.right, rule.disparities, rule.minimum, rule.keep, rule.tolerance, pixels[y], strength[y])
        y += step

@njit(nogil=True, error_model="numpy", cache=True)
def add_prior(costs, prior, prior_costs, width):
    n = lanes_in(width)
    for x in range(prior.size):
        store(costs, x * n, plus_capped(load(costs, x * n, width), load(prior_costs, prior[x], width)))
