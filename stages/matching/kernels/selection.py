"""Selection: the disparity of each pixel from the sums of its paths, and whether it is reliable.

The smallest sum wins. Two lines of equal and opposite slopes through it and its neighbours give the fraction of a pixel
(Shimizu and Okutomi, 2001): the sums fall and rise like a V, and a parabola would pull disparities towards whole
numbers by up to 0.1 px more. A winner must beat every disparity that is not its neighbour (uniqueness), and the right
image's pixel must choose the same from the same sums (left-right check). That choice needs all sums of a row along a
diagonal. The trick is to keep the best so far of n right pixels in the lanes of one vector, which moves by one lane
from pixel to pixel, as the partners do.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import part
from stages.compiled.simd import (
    bit_or,
    broadcast,
    byte,
    count_up,
    first_smallest,
    lanes_in,
    last_lane,
    lesser,
    load,
    shifted,
    smallest,
    store,
    where_less,
)  # fmt: skip
from stages.data import Array, PixelOrigin
from stages.matching.kernels.sgm_params import SgmParams

MEASURED, OUT_OF_VIEW, OUT_OF_RANGE, LEFT_RIGHT, UNIQUENESS = (
    np.uint8(PixelOrigin[name]) for name in ("MEASURED", "OUT_OF_VIEW", "OUT_OF_RANGE", "LEFT_RIGHT", "UNIQUENESS")
)


@part
def find_winners(total, beyond, guard, winner, votes, right, width):
    """The best disparity of each pixel of a row, left and right; the smallest of equals.

    total: (W * n,) uint8, the sums; beyond: (n,) uint8, 255 for lanes that are no disparities; guard: (2 n,) uint8, 255
    at n - 1, n, n + 1, else 0. Into winner (W,) int16, votes (4, W) uint16: sum of the winner, of its lower and upper
    neighbour, and the smallest of the others; and right (W + n,) uint8 or uint16: the right image's winners, backwards,
    that of the partner of left pixel x at disparity d at W - 1 - x + d.
    """
    n, columns = lanes_in(width), winner.size
    lanes, outside = count_up(width, right), load(beyond, 0, width)
    best, index = broadcast(255, width), lanes
    for x in range(columns):
        sums = bit_or(load(total, x * n, width), outside)
        find_winner(sums, total, guard, x, winner, votes, width)
        best, index = shifted(best, 255, 1), shifted(index, 0, 1)
        index, best = where_less(sums, best, lanes, index), lesser(sums, best)
        right[columns + n - 2 - x] = last_lane(index)
    store(right, 0, index)


@part
def find_winner(sums, total, guard, x, winner, votes, width):
    """The winner and the votes of pixel x, as `find_winners` defines them. sums: of the pixel, as in `total`."""
    n = lanes_in(width)
    low, d = first_smallest(sums)
    winner[x] = d
    votes[0, x] = low
    votes[1, x] = byte(total, x * n + max(d - 1, 0))
    votes[2, x] = byte(total, x * n + min(d + 1, n - 1))
    votes[3, x] = smallest(bit_or(sums, load(guard, n - d, width)))


@part
def find_partners(winner, right, partners):
    """The choice of the winner's partner in the right image, into (W,) int16. winner, right: of `find_winners`."""
    columns = winner.size
    for x in range(columns):
        partners[x] = right[np.uint64(columns - 1 - x + winner[x])]


@part
def keep_costs(votes, costs, y):
    """Keep the sum of the winner and the smallest of the others in row y of `costs`, unless it has no rows.

    votes: of `find_winners`; costs: (2, H, W) uint8.
    """
    if costs.shape[1]:
        for x in range(costs.shape[2]):
            costs[0, y, x], costs[1, y, x] = votes[0, x], votes[3, x]


@part
def fit_row(winner, votes, partners, first, top, params, pixels, evidence, source):
    """Disparities of a row, to a fraction of a pixel, where the winner is reliable, the evidence, and the reasons.

    winner, votes, partners: of `find_winners` and `find_partners`; first: (W,) int32, disparity of the first lane;
    top: the last lane that is a disparity; params: `SgmParams`; into pixels (W,) float32, px, NaN = unknown; evidence
    (W,) uint8: by how much the winner beats all but its neighbours, 0 where unknown; source (W,) uint8: codes of
    `PixelOrigin`, the first check that fails.

    A winner at an end of the search range, or with a neighbour outside the right image, is none: its lines would lean
    on a sum that means nothing, and the smallest may lie beyond.
    """
    columns = winner.size
    last, top = np.int32(columns - 1), np.int32(top)
    tolerance, margin = np.int32(params.lr_tolerance), np.int32(params.uniqueness)
    for x in range(columns):
        d = np.int32(winner[x])
        low, next_best = np.int32(votes[0, x]), np.int32(votes[3, x])
        lower, upper = np.int32(votes[1, x]), np.int32(votes[2, x])
        partner = np.int32(np.int32(x) - first[x] - d)
        apart = abs(np.int32(np.int32(partners[x]) - d))
        lead = np.int32(next_best - low)
        in_view, in_range = (partner > 0) & (partner < last), (d > 0) & (d < top)
        unique, agreed = lead > margin, apart <= tolerance
        sound = in_view & in_range & unique & agreed
        rise = max(np.int32(max(lower, upper) - low), np.int32(1))
        value = np.float32(first[x] + d) + np.float32(lower - upper) / np.float32(rise + rise)
        pixels[x] = value if sound else np.float32(np.nan)
        evidence[x] = np.uint8(lead) if sound else np.uint8(0)
        reason = MEASURED if agreed else LEFT_RIGHT
        reason = reason if unique else UNIQUENESS
        reason = reason if in_range else OUT_OF_RANGE
        source[x] = reason if in_view else OUT_OF_VIEW


def costs_reference(total: Array) -> Array:
    """`keep_costs` of a row, (2, W) uint8, in plain numpy. total: of `select_reference`."""
    lanes, best = np.arange(total.shape[1]), np.argmin(total, axis=1)
    others = np.where(np.abs(lanes - best[:, np.newaxis]) <= 1, 255, total)
    return np.stack([total.min(axis=1), others.min(axis=1)]).astype(np.uint8)


def select_reference(total: Array, first: Array, lowest: int, n: int, params: SgmParams) -> tuple[Array, Array, Array]:
    """Disparities, evidence and source of a row in plain numpy.

    total: (W, m) the sums of all paths, from disparity `lowest` on, 255 where not searched; first: (W,) the disparity
    of the first of the n that are searched.
    """
    columns, disparities = total.shape
    sums = total.astype(np.int64)
    right = np.zeros(columns, np.int64)
    for r in range(columns):
        seen = [(sums[r + d, d - lowest], d) for d in range(lowest, lowest + disparities) if 0 <= r + d < columns]
        right[r] = min(seen)[1] if seen else lowest
    pixels, evidence, source = np.full(columns, np.nan, np.float32), *np.zeros((2, columns), np.uint8)
    for x in range(columns):
        d = int(np.argmin(sums[x]))
        lane, partner = d + lowest - first[x], x - lowest - d
        if not 0 < partner < columns - 1:
            source[x] = PixelOrigin.OUT_OF_VIEW
            continue
        if not 0 < lane < n - 1:
            source[x] = PixelOrigin.OUT_OF_RANGE
            continue
        low, before, after = sums[x, d], sums[x, d - 1], sums[x, d + 1]
        lead = min([255, *sums[x, : d - 1], *sums[x, d + 2 :]]) - low
        if lead <= params.uniqueness:
            source[x] = PixelOrigin.UNIQUENESS
        elif abs(right[partner] - d - lowest) > params.lr_tolerance:
            source[x] = PixelOrigin.LEFT_RIGHT
        else:
            rise = max(max(before, after) - low, 1)
            pixels[x] = np.float32(lowest + d) + np.float32(before - after) / np.float32(2 * rise)
            evidence[x], source[x] = lead, PixelOrigin.MEASURED
    return pixels, evidence, source
