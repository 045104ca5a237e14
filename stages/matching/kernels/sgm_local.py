"""Semi-global matching near a prior: each pixel is searched in a small window of disparities only.

Cost, paths and selection are those of the search of a whole range (`semiglobal`), in a fraction of the time, and no
disparity is too large. The trick is how windows of neighbouring pixels that begin at different disparities are
aligned: the lanes of each window stand in memory between stretches of 255, "not searched". They are loaded from as many
bytes later or earlier as the other window begins.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from stages.compiled.jit import kernel, part
from stages.compiled.parallel import Fork
from stages.compiled.simd import (
    Width,
    average,
    broadcast,
    byte,
    lanes_in,
    lesser,
    load,
    plus,
    plus_capped,
    shifted,
    store,
    where_less,
)  # fmt: skip
from stages.compiled.workspace import Workspace
from stages.data import Array
from stages.matching.kernels.aggregation import NOT_SEARCHED, aggregate_reference, next_path
from stages.matching.kernels.gradient import raw_costs, raw_costs_reference, smoothed_reference
from stages.matching.kernels.matching_inputs import MatchingInputs
from stages.matching.kernels.selection import costs_reference, find_winner, fit_row, keep_costs, select_reference
from stages.matching.kernels.sgm_params import SgmParams

WINDOW_STEP = 4  # windows begin at multiples of it, so most neighbouring windows begin together
WINDOW_EDGE = 1  # lanes at either end of a window that cannot win
MAX_PRIOR = np.float32(1e6)  # px; larger than any image, and an exact float32
SLOT_GAP = 16  # bytes by which the stretch between two slots is longer than the lanes


class SearchWindows(NamedTuple):
    """The window of disparities that is searched at each pixel."""

    first: Array  # (H, W) int32, px, disparity of the first lane
    width: Width


def windows_around(prior: Array, radius: int, min_disparity: int) -> SearchWindows:
    """Windows that reach `radius` px from the prior to either side, within the image and not below `min_disparity`.

    prior: (H, W) float32, px; a pixel without a prior (NaN) has the window of the pixel to the left.
    """
    lanes = -(-(2 * (radius + WINDOW_EDGE) + WINDOW_STEP + 1) // 16) * 16
    first = np.empty(prior.shape, np.int32)
    _begin(prior, lanes, min_disparity, first)
    return SearchWindows(first, Width(lanes))


@kernel
def _begin(prior, lanes, min_disparity, first):
    height, columns = prior.shape
    middle = np.float32((lanes - 1) / 2)
    for y in range(height):
        begin = min_disparity
        for x in range(columns):
            if np.isfinite(prior[y, x]):
                near = min(max(prior[y, x], -MAX_PRIOR), MAX_PRIOR)
                begin = WINDOW_STEP * np.int64(np.rint((near - middle) / WINDOW_STEP))
            # The first partner is inside the image.
            first[y, x] = min(max(begin, min_disparity, x - columns + 1), x)


def match_windows(
    inputs: MatchingInputs,
    params: SgmParams,
    windows: SearchWindows,
    layers: tuple[Array, Array, Array, Array],
    space: Workspace,
    run_both: Fork,
) -> None:
    """Write disparities, evidence, source and costs of all pixels into `layers`.

    inputs: for a `min_disparity` of 0, with the prior's costs from the beginning of each window on; layers: (H, W)
    each: float32, px, NaN = unknown; uint8; uint8, codes of `PixelOrigin`; and those of `selection.keep_costs`.
    """
    first, width = windows
    height, columns = first.shape
    size, slots = columns * width.lanes, _slots(columns, width.lanes)
    space.reserve(2 * (height * size + 64) + 14 * (slots + 64))
    costs, sums = (space.array((height, size), np.uint8) for _ in range(2))
    one, other = (space.array((7, slots), np.uint8) for _ in range(2))
    upper, lower = (0, height // 2), (height // 2, height)
    make = functools.partial(_costs, inputs, params, width, first, costs)
    arrive = functools.partial(_arrive, inputs.steps, params, width, first, costs, sums)
    lanes = int(first.min()), int(first.max())
    cross = functools.partial(_cross, inputs.steps, params, width, first, costs, sums, *lanes, layers)
    run_both(lambda: make(upper, one), lambda: make(lower, other))
    run_both(lambda: arrive(upper, 1, one), lambda: arrive(lower, -1, other))
    run_both(lambda: cross(lower, 1, one), lambda: cross(upper, -1, other))


def _slots(columns: int, lanes: int) -> int:
    """Bytes of a row of slots: one for each pixel, and one beyond either end."""
    return (columns + 2) * (2 * lanes + SLOT_GAP) + lanes + SLOT_GAP


@part
def _slot(x, width):
    """The index at which the lanes of pixel x begin; x is -1 to W."""
    n = lanes_in(width)
    return (x + 1) * (2 * n + SLOT_GAP) + n + SLOT_GAP


@part
def _place(x, later, width):
    """The index of the lanes in slot x for a window that begins `later` px farther."""
    n = lanes_in(width)
    return _slot(x, width) + min(max(later, -n - 1), n + 1)


@part
def _or_own(row, x, later, own, width):
    """The lanes in slot x for a window that begins `later` px farther; `own` where slot x was not searched."""
    found = load(row, _place(x, later, width), width)
    return where_less(found, broadcast(NOT_SEARCHED, width), found, own)


@kernel
def _costs(inputs, params, width, first, costs, span, rows):
    """The costs of rows span[0] to span[1] (exclusive), of W * n bytes each, with the prior's.

    They equal those of the whole range, except that the pixel's own cost stands in for neighbours that were not
    searched at a disparity.
    """
    rows[:] = NOT_SEARCHED
    for y in range(span[0] - 1, span[1] + 1):  # a mean needs the rows before and after
        _sum_columns(inputs, params, first, min(max(y, 0), first.shape[0] - 1), rows[3], rows[y % 3], width)
        if y > span[0]:
            _smooth(inputs, first, y - 1, rows, costs[y - 1], width)


@part
def _sum_columns(inputs, params, first, y, raw, sums, width):
    """The costs of row y, summed over 3 columns, into the slots of `sums`."""
    columns = first.shape[1]
    left, right = inputs.left[y], inputs.right[y]
    for x in range(columns):
        partners = columns - 1 - x + first[y, x]
        store(raw, _slot(x, width), raw_costs(left, right, inputs, params.unseen_cost, x, partners, width))
    for x in range(columns):
        own, here = load(raw, _slot(x, width), width), first[y, x]
        west, east = max(x - 1, 0), min(x + 1, columns - 1)
        three = plus(_or_own(raw, west, here - first[y, west], own, width), own)
        store(sums, _slot(x, width), plus(three, _or_own(raw, east, here - first[y, east], own, width)))


@part
def _smooth(inputs, first, y, rows, costs, width):
    """The mean of the sums of rows y - 1, y and y + 1, of which y counts twice; and what the prior adds."""
    n, (height, columns) = lanes_in(width), first.shape
    north, south, nothing = max(y - 1, 0), min(y + 1, height - 1), broadcast(0, width)
    above, below = rows[(y + 2) % 3], rows[(y + 1) % 3]
    for x in range(columns):
        own, here = load(rows[y % 3], _slot(x, width), width), first[y, x]
        rise = inputs.slope[y, x] if inputs.slope.size > 0 else 0
        up = _or_own(above, x, here - first[north, x] - rise, own, width)
        down = _or_own(below, x, here - first[south, x] + rise, own, width)
        cost = average(average(average(average(up, down), own), nothing), nothing)
        store(costs, x * n, plus_capped(cost, load(inputs.prior_costs, inputs.prior[y, x], width)))


@kernel
def _arrive(steps, params, width, first, costs, sums, span, step, rows):
    """The sums of the first rows of a sweep down (step 1) or up (-1): span[0] to span[1] (exclusive).

    The paths stay in `rows`.
    """
    rows[:] = NOT_SEARCHED
    for k in range(6):
        for x in range(-1, first.shape[1] + 1):
            store(rows[k], _slot(x, width), broadcast(0, width))  # a path begins here
    for i in range(span[1] - span[0]):
        y = span[0] + i if step > 0 else span[1] - 1 - i
        _add_paths(steps, params, width, first, y, step, costs[y], rows, sums[y])


@part
def _add_paths(steps, params, width, first, y, step, from_cost, rows, total):
    """Row y of a sweep: the paths of `aggregation.aggregate_row`, and their sums."""
    n, (height, columns) = lanes_in(width), first.shape
    nothing, p1, table = broadcast(0, width), broadcast(params.p1, width), params.p2_table
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
            if side == 2 or params.diagonals:
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
    """The path along a row, continued into a window that begins `later` px farther."""
    if later == 0:
        near = lesser(shifted(path, NOT_SEARCHED, 1), shifted(path, NOT_SEARCHED, -1))
        return next_path(path, near, cost, p1, p2, width)
    store(row, _slot(0, width), path)
    return _next_from(row, _place(0, later, width), cost, p1, p2, width)


@part
def _next_from(row, place, cost, p1, p2, width):
    near = lesser(load(row, place - 1, width), load(row, place + 1, width))
    return next_path(load(row, place, width), near, cost, p1, p2, width)


@kernel
def _cross(steps, params, width, first, costs, sums, first_min, first_max, layers, span, step, rows):
    """Disparities, evidence and source of rows span[0] to span[1] (exclusive), as `selection` finds and checks them.

    A sweep that arrives with the paths in `rows` continues into these rows. The sums of the other sweep are there.
    """
    (pixels, evidence, source, kept), n, columns = layers, lanes_in(width), first.shape[1]
    total, best = np.empty(columns * n, np.uint8), np.empty(columns + n, np.uint8)
    order = np.arange(first_max - first_min + n).astype(np.uint16)
    chosen = np.zeros(columns + n, np.uint16)  # by the right image's pixels, backwards, less `first_min`
    guard = np.where(np.abs(np.arange(2 * n) - n) <= 1, 255, 0).astype(np.uint8)
    winner, votes, partners = (
        np.empty(columns, np.int16),
        np.empty((4, columns), np.uint16),
        np.empty(columns, np.int16),
    )
    for i in range(span[1] - span[0]):
        y = span[0] + i if step > 0 else span[1] - 1 - i
        _add_paths(steps, params, width, first, y, step, costs[y], rows, total)
        best[:] = 255
        other, begin = sums[y], first[y]
        for x in range(columns):
            added = plus_capped(load(total, x * n, width), load(other, x * n, width))
            store(total, x * n, added)
            find_winner(added, total, guard, x, winner, votes, width)
            right = columns - 1 - x + begin[x]
            known, here = load(best, right, width), load(order, begin[x] - first_min, width)
            store(chosen, right, where_less(added, known, here, load(chosen, right, width)))
            store(best, right, lesser(added, known))
        for x in range(columns):
            partners[x] = chosen[columns - 1 - x + begin[x] + winner[x]] + first_min - begin[x]
        fit_row(winner, votes, partners, begin, n - 1, params, pixels[y], evidence[y], source[y])
        keep_costs(votes, kept, y)


def match_windows_reference(inputs: MatchingInputs, params: SgmParams, windows: SearchWindows) -> list[Array]:
    """The layers of `match_windows` in plain numpy.

    It works in volumes of all disparities of any window, with 255 for disparities outside the pixel's own window.
    """
    first, n = windows.first, windows.width.lanes
    lanes = first[..., np.newaxis] - first.min() + np.arange(n)
    searched = np.zeros((*first.shape, int(lanes.max()) + 1), bool)
    np.put_along_axis(searched, lanes, True, axis=2)
    costs = np.full(searched.shape, NOT_SEARCHED)
    columns = first.shape[1]
    partner = np.arange(columns)[:, np.newaxis] - first[..., np.newaxis] - np.arange(n)
    planes = inputs.left[:, :, :columns], inputs.right[:, :, :columns][:, :, ::-1]
    np.put_along_axis(costs, lanes, raw_costs_reference(*planes, partner, params.unseen_cost), axis=2)
    costs = smoothed_reference(costs, searched, inputs.slope, -1)
    pull = inputs.prior_costs[inputs.prior[..., np.newaxis] + np.arange(n)]
    np.put_along_axis(costs, lanes, np.minimum(np.take_along_axis(costs, lanes, axis=2) + pull, 255), axis=2)
    sums = sum(aggregate_reference(inputs.steps, params, costs, searched, sign) for sign in (1, -1))
    total = np.where(searched, np.minimum(sums, 255), 255)
    rows = [select_reference(total[y], first[y], int(first.min()), n, params) for y in range(first.shape[0])]
    costs = np.stack([costs_reference(row) for row in total], axis=1)
    return [*(np.stack(layer) for layer in zip(*rows, strict=True)), costs]
