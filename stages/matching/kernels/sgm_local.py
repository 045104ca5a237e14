"""Semi-global matching around a prior: of each pixel only a few disparities are searched, those about what it is
expected to have.

Cost, paths and selection are those of the search of a whole range (`semiglobal`), at a fraction of its
time, and nothing is too near to be found. The trick is how windows of neighbouring pixels that begin at different
disparities are brought together: the lanes of each stand in memory between stretches of 255, "not searched", and are
loaded from as many bytes later or earlier as the other window begins.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from stages.compiled.jit import kernel, part
from stages.compiled.parallel import Fork, by_bands, shared_by
from stages.compiled.simd import (
    Width,
    average,
    byte,
    lanes_in,
    lesser,
    load,
    plus,
    plus_capped,
    shifted,
    spread,
    store,
    where_less,
)  # fmt: skip
from stages.compiled.workspace import Workspace
from stages.data import Array
from stages.matching.kernels.aggregation import FAR, aggregate_reference, next_path
from stages.matching.kernels.census import PLANES, census_costs
from stages.matching.kernels.gradient import LARGEST, raw_costs
from stages.matching.kernels.matching_inputs import MatchingInputs
from stages.matching.kernels.selection import find_winner, fit_row, select_reference
from stages.matching.kernels.sgm_params import SgmParams

STEP = 4  # windows begin at multiples of it, so that those of neighbours mostly begin together
EDGE = 1  # lanes at either end of a window that cannot win
FARTHEST = np.float32(1e6)  # px; beyond any image, and still a whole number
GAP = 16  # by how much the stretch between two slots is longer than the lanes


class SearchWindows(NamedTuple):
    """Where the search of every pixel begins, and how far it goes."""

    first: Array  # (H, W) int32, px, disparity of the first lane
    width: Width


def windows(prior: Array, reach: int, least: int, threads: int = 1) -> SearchWindows:
    """Windows that reach `reach` px from the prior to either side, where the image and `least` allow.

    prior: (H, W) float32, px, NaN = none: the window is then that of the pixel to the left; least: px, the smallest
    disparity searched; threads: 2 share the work, to the same result.
    """
    lanes = -(-(2 * (reach + EDGE) + STEP + 1) // 16) * 16
    first = np.empty(prior.shape, np.int32)

    def work(top: int, end: int) -> None:
        _begin(prior[top:end], lanes, least, first[top:end])

    by_bands(shared_by(threads), len(prior), work)
    return SearchWindows(first, Width(lanes))


@kernel
def _begin(prior, lanes, least, first):
    height, columns = prior.shape
    middle = np.float32((lanes - 1) / 2)
    for y in range(height):
        begin = least
        for x in range(columns):
            if np.isfinite(prior[y, x]):
                near = min(max(prior[y, x], -FARTHEST), FARTHEST)
                begin = STEP * np.int64(np.rint((near - middle) / STEP))
            # The first partner is inside the image.
            first[y, x] = min(max(begin, least, x - columns + 1), x)


def search_around(
    pair: MatchingInputs,
    rule: SgmParams,
    windows: SearchWindows,
    layers: tuple[Array, Array, Array],
    space: Workspace,
    both: Fork,
) -> None:
    """Write disparities, evidence and source of all pixels into `layers`.

    layers: (H, W) each, float32, px, NaN = unknown; uint8; uint8, codes of `PixelOrigin`;
    pair: of a rule whose minimum is 0, with the prior's costs from the beginning of each window on.
    """
    first, width = windows
    height, columns = first.shape
    size, slots = columns * width.lanes, _slots(columns, width.lanes)
    space.reserve(2 * (height * size + 64) + 14 * (slots + 64))
    costs, sums = (space.array((height, size), np.uint8) for _ in range(2))
    one, other = (space.array((7, slots), np.uint8) for _ in range(2))
    upper, lower = (0, height // 2), (height // 2, height)
    make = functools.partial(_costs, pair, rule, width, first, costs)
    arrive = functools.partial(_arrive, pair.steps, rule, width, first, costs, sums)
    lanes = int(first.min()), int(first.max())
    cross = functools.partial(_cross, pair.steps, rule, width, first, costs, sums, *lanes, layers)
    both(lambda: make(upper, one), lambda: make(lower, other))
    both(lambda: arrive(upper, 1, one), lambda: arrive(lower, -1, other))
    both(lambda: cross(lower, 1, one), lambda: cross(upper, -1, other))


def _slots(columns: int, lanes: int) -> int:
    """Bytes of a row of slots, one for each pixel and one beyond either end."""
    return (columns + 2) * (2 * lanes + GAP) + lanes + GAP


@part
def _slot(x, width):
    """Where the lanes of pixel x begin, from -1 on."""
    n = lanes_in(width)
    return (x + 1) * (2 * n + GAP) + n + GAP


@part
def _place(x, later, width):
    """Where the lanes in slot x begin for a window that begins `later`."""
    n = lanes_in(width)
    return _slot(x, width) + min(max(later, -n - 1), n + 1)


@part
def _or_own(row, x, later, own, width):
    """The lanes in slot x as a window has them that begins `later`; those that were not searched are `own`."""
    found = load(row, _place(x, later, width), width)
    return where_less(found, spread(FAR, width), found, own)


@kernel
def _costs(pair, rule, width, first, costs, span, rows):
    """The costs of rows span[0] to span[1] (exclusive), of W * n bytes each, with the prior's.

    As those of the whole range; but where a neighbour was not searched at a disparity, the pixel's own cost counts.
    """
    if rule.gradient:
        rows[:] = FAR
        for y in range(span[0] - 1, span[1] + 1):  # a mean needs the rows before and after
            _sum_columns(pair, rule, first, min(max(y, 0), first.shape[0] - 1), rows[3], rows[y % 3], width)
            if y > span[0]:
                _smooth(pair, first, y - 1, rows, costs[y - 1], width)
    else:
        n, columns = lanes_in(width), first.shape[1]
        for y in range(span[0], span[1]):
            left, right, row = pair.left[y], pair.right[y], costs[y]
            for x in range(columns):
                partners = columns - 1 - x + first[y, x]
                cost = census_costs(left, right, pair, rule.unseen, x, partners, width)
                store(row, x * n, plus_capped(cost, load(pair.prior_costs, pair.prior[y, x], width)))


@part
def _sum_columns(pair, rule, first, y, raw, sums, width):
    """The costs of row y, summed over 3 columns, into the slots of `sums`."""
    columns = first.shape[1]
    left, right = pair.left[y], pair.right[y]
    for x in range(columns):
        partners = columns - 1 - x + first[y, x]
        store(raw, _slot(x, width), raw_costs(left, right, pair, rule.unseen, x, partners, width))
    for x in range(columns):
        own, here = load(raw, _slot(x, width), width), first[y, x]
        west, east = max(x - 1, 0), min(x + 1, columns - 1)
        three = plus(_or_own(raw, west, here - first[y, west], own, width), own)
        store(sums, _slot(x, width), plus(three, _or_own(raw, east, here - first[y, east], own, width)))


@part
def _smooth(pair, first, y, rows, costs, width):
    """The mean of the sums of rows y - 1, y and y + 1, of which y counts twice; and what the prior adds."""
    n, (height, columns) = lanes_in(width), first.shape
    north, south, nothing = max(y - 1, 0), min(y + 1, height - 1), spread(0, width)
    above, below = rows[(y + 2) % 3], rows[(y + 1) % 3]
    for x in range(columns):
        own, here = load(rows[y % 3], _slot(x, width), width), first[y, x]
        up = _or_own(above, x, here - first[north, x], own, width)
        down = _or_own(below, x, here - first[south, x], own, width)
        cost = average(average(average(average(up, down), own), nothing), nothing)
        store(costs, x * n, plus_capped(cost, load(pair.prior_costs, pair.prior[y, x], width)))


@kernel
def _arrive(steps, rule, width, first, costs, sums, span, step, rows):
    """The sums of the paths of a sweep down (step 1) or up (-1) in rows span[0] to span[1] (exclusive), with which it
    begins; the paths stay in `rows`."""
    rows[:] = FAR
    for k in range(6):
        for x in range(-1, first.shape[1] + 1):
            store(rows[k], _slot(x, width), spread(0, width))  # a path begins here
    for i in range(span[1] - span[0]):
        y = span[0] + i if step > 0 else span[1] - 1 - i
        _add_paths(steps, rule, width, first, y, step, costs[y], rows, sums[y])


@part
def _add_paths(steps, rule, width, first, y, step, from_cost, rows, total):
    """Row y of a sweep: its paths, as `aggregation.aggregate_row` follows them, and their sums."""
    n, (height, columns) = lanes_in(width), first.shape
    nothing, p1, table = spread(0, width), spread(rule.p1, width), rule.table
    up = 1 if step < 0 else 0  # steps of brightness are those from above and from the left
    before, after = 3 * (y & 1), 3 * (1 - (y & 1))
    path, begin = nothing, 0
    for j in range(columns):
        x = j if step > 0 else columns - 1 - j
        cost, here = load(from_cost, x * n, width), first[y, x]
        later = here - begin if j > 0 else 0
        path = _next_beside(path, rows[6], later, cost, p1, byte(table, byte(steps[0, y], x + 1 + up)), width)
        begin, so_far = here, path
        for side in range(1, 4):
            if side == 2 or rule.diagonals:
                across = (side - 2) * step
                inside = 0 <= y - step < height and 0 <= x + across < columns
                later = here - first[y - step, x + across] if inside else 0
                p2 = byte(table, byte(steps[side, y + up], x + 1 - up * (side - 2)))
                moved = _next_from(rows[before + side - 1], _place(x + across, later, width), cost, p1, p2, width)
                store(rows[after + side - 1], _slot(x, width), moved)
                so_far = plus_capped(so_far, moved)
        store(total, x * n, so_far)


@part
def _next_beside(path, row, later, cost, p1, p2, width):
    """The path along a row, which is at hand, continued into a window that begins `later`."""
    if later == 0:
        near = lesser(shifted(path, FAR, 1), shifted(path, FAR, -1))
        return next_path(path, near, cost, p1, p2, width)
    store(row, _slot(0, width), path)
    return _next_from(row, _place(0, later, width), cost, p1, p2, width)


@part
def _next_from(row, place, cost, p1, p2, width):
    near = lesser(load(row, place - 1, width), load(row, place + 1, width))
    return next_path(load(row, place, width), near, cost, p1, p2, width)


@kernel
def _cross(steps, rule, width, first, costs, sums, lowest, highest, layers, span, step, rows):
    """Disparities, evidence and source of rows span[0] to span[1] (exclusive), as `selection` finds and checks them.

    A sweep that arrives with the paths in `rows` continues into these rows. The sums of the other sweep are there.
    """
    (pixels, evidence, source), n, columns = layers, lanes_in(width), first.shape[1]
    total, best = np.empty(columns * n, np.uint8), np.empty(columns + n, np.uint8)
    order = np.arange(highest - lowest + n).astype(np.uint16)
    chosen = np.zeros(columns + n, np.uint16)  # by the right image's pixels, backwards, less `lowest`
    guard = np.where(np.abs(np.arange(2 * n) - n) <= 1, 255, 0).astype(np.uint8)
    winner, votes, partners = (
        np.empty(columns, np.int16),
        np.empty((4, columns), np.uint16),
        np.empty(columns, np.int16),
    )
    for i in range(span[1] - span[0]):
        y = span[0] + i if step > 0 else span[1] - 1 - i
        _add_paths(steps, rule, width, first, y, step, costs[y], rows, total)
        best[:] = 255
        other, begin = sums[y], first[y]
        for x in range(columns):
            both = plus_capped(load(total, x * n, width), load(other, x * n, width))
            store(total, x * n, both)
            find_winner(both, total, guard, x, winner, votes, width)
            right = columns - 1 - x + begin[x]
            known, here = load(best, right, width), load(order, begin[x] - lowest, width)
            store(chosen, right, where_less(both, known, here, load(chosen, right, width)))
            store(best, right, lesser(both, known))
        for x in range(columns):
            partners[x] = chosen[columns - 1 - x + begin[x] + winner[x]] + lowest - begin[x]
        fit_row(winner, votes, partners, begin, n - 1, rule, pixels[y], evidence[y], source[y])


def search_around_reference(pair: MatchingInputs, rule: SgmParams, windows: SearchWindows) -> list[Array]:
    """The layers of `search_around` in plain numpy.

    It works in volumes of all disparities of any window, with 255 for disparities outside the pixel's own window.
    """
    first, n = windows.first, windows.width.lanes
    lanes = first[..., np.newaxis] - first.min() + np.arange(n)
    searched = np.zeros((*first.shape, int(lanes.max()) + 1), bool)
    np.put_along_axis(searched, lanes, True, axis=2)
    costs = np.full(searched.shape, FAR)
    np.put_along_axis(costs, lanes, _raw_costs_reference(pair, rule, first, n), axis=2)
    if rule.gradient:
        costs = _smoothed_reference(costs, searched)
    pull = pair.prior_costs[pair.prior[..., np.newaxis] + np.arange(n)]
    np.put_along_axis(costs, lanes, np.minimum(np.take_along_axis(costs, lanes, axis=2) + pull, 255), axis=2)
    sums = sum(aggregate_reference(pair.steps, rule, costs, searched, sign) for sign in (1, -1))
    total = np.where(searched, np.minimum(sums, 255), 255)
    rows = [select_reference(total[y], first[y], int(first.min()), n, rule) for y in range(first.shape[0])]
    return [np.stack(layer) for layer in zip(*rows, strict=True)]


def _raw_costs_reference(pair: MatchingInputs, rule: SgmParams, first: Array, n: int) -> Array:
    """The costs in the windows, not smoothed, (H, W, n) int64."""
    height, columns = first.shape
    partner = columns - 1 - np.arange(columns)[:, np.newaxis] + first[..., np.newaxis] + np.arange(n)
    left = pair.left[:, :, :columns].transpose(1, 0, 2)[..., np.newaxis]
    right = pair.right.transpose(1, 0, 2)[:, np.arange(height)[:, np.newaxis, np.newaxis], partner]
    costs = np.bitwise_count(left[:PLANES] ^ right[:PLANES]).sum(axis=0, dtype=np.int64)
    if rule.gradient:
        step = np.abs(left[PLANES:].astype(int) - right[PLANES:]).sum(axis=0)
        costs = 2 * costs + 5 * np.minimum(step, LARGEST)
    return np.where(pair.outside[partner] > 0, rule.unseen, costs)


def _smoothed_reference(raw: Array, searched: Array) -> Array:
    """Means over 3x3 pixels, in which a pixel's own stands for what a neighbour lacks."""

    def neighbours(costs: Array, axis: int) -> tuple[Array, Array]:
        pad = [(int(axis == k),) * 2 for k in range(3)]
        wide = np.where(np.pad(searched, pad, mode="edge"), np.pad(costs, pad, mode="edge"), -1)
        length = costs.shape[axis]
        one, other = wide.take(range(length), axis), wide.take(range(2, length + 2), axis)
        return np.where(one < 0, costs, one), np.where(other < 0, costs, other)

    west, east = neighbours(raw, 1)
    three = west + raw + east
    up, down = neighbours(three, 0)
    mean = ((up + down + 1) // 2 + three + 1) // 2
    smoothed: Array = np.where(searched, ((mean + 1) // 2 + 1) // 2, FAR)
    return smoothed
