"""Which disparities a band of rows is searched for: a row of a rover's image shows ground at much the same distance, so
no more than what a prior has there, and some.

Bands may differ in where their range begins and in how many lanes hold it. Between two of them the costs of the paths
are moved to where the other band has those disparities; what only one of them has was "not searched".
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from stages.compiled.jit import kernel
from stages.compiled.parallel import by_bands, shared_by
from stages.compiled.simd import Width
from stages.data import Array

MARGIN = 8  # px to either side of what the prior has in a band
OUTLIERS = 0.001  # share of a band's prior, at either end, that does not count: it is less than a speck
LEAST_KNOWN = 0.5  # share of a band's pixels below which its prior does not tell the range
NARROW = (64, 128)  # lanes, but for the whole range; each number is compiled when it comes first


class Range(NamedTuple):
    """What rows top to end (exclusive) are searched for."""

    top: int
    end: int
    first: int  # its first disparity, less the smallest of the whole range
    width: Width


def lanes_for(disparities: int) -> int:
    """The number of lanes that hold a search range: what the processor divides well, not less than 16."""
    return next((n for n in (16, 32, 64, 96) if disparities <= n), -(-disparities // 64) * 64)


def whole_range(rows: int, disparities: int) -> list[Range]:
    """The one band of an image of which all rows are searched for all disparities."""
    return [Range(0, rows, 0, Width(lanes_for(disparities)))]


def ranges_of(prior: Array, height: int, minimum: int, disparities: int, threads: int = 1) -> list[Range]:
    """The bands of an image, of `height` rows each, and their ranges.

    prior: (H, W) float32, px, NaN = unknown; minimum, disparities: px, the whole range; threads: 2 share the work, to
    the same result.
    """
    rows, columns = prior.shape
    cuts = [*range(0, rows, height), rows]
    counts = np.zeros((len(cuts) - 1, disparities), np.int64)

    def count(first: int, end: int) -> None:
        for i in range(first, end):
            _count(prior, cuts[i], cuts[i + 1], minimum, counts[i])

    by_bands(shared_by(threads), len(counts), count)
    most, ranges = lanes_for(disparities), []
    for (top, end), number in zip(itertools.pairwise(cuts), counts, strict=True):
        up_to = np.cumsum(number)
        ignored = int(OUTLIERS * up_to[-1])
        low, high = np.searchsorted(up_to, [ignored, up_to[-1] - ignored - 1], side="right").tolist()
        low, high = max(low - MARGIN, 0), min(high + MARGIN, disparities - 1)
        needed = high - low + 1
        lanes = next((n for n in NARROW if needed <= n < most), most)
        if lanes == most or up_to[-1] < LEAST_KNOWN * (end - top) * columns:
            ranges.append(Range(top, end, 0, Width(most)))
        else:
            first = low - (lanes - needed) // 2
            ranges.append(Range(top, end, min(max(first, 0), disparities - lanes), Width(lanes)))
    return ranges


def within(rows: range, ranges: list[Range]) -> Iterator[tuple[range, Range]]:
    """`rows`, in their order, range by range."""
    low, high = min(rows[0], rows[-1]), max(rows[0], rows[-1])
    for each in ranges if rows.step > 0 else reversed(ranges):
        part = range(max(low, each.top), min(high + 1, each.end))
        if part:
            yield part[:: rows.step], each


@kernel
def _count(prior, top, end, minimum, counts):
    """Add up how many of rows top to end have each disparity; what is beyond the range is at its end."""
    last = np.float32(counts.size - 1)
    for y in range(top, end):
        for x in range(prior.shape[1]):
            place = np.rint(prior[y, x]) - np.float32(minimum)
            if np.isfinite(place):
                counts[np.int64(min(max(place, np.float32(0)), last))] += 1


@kernel
def move_paths(paths, lanes, later, moved, other_lanes):
    """Costs of paths, `lanes` for each place, as those of a range that begins `later` and has `other_lanes`: what it
    has and the other had not is 255, not searched."""
    begin = min(max(-later, 0), other_lanes)
    stop = max(min(lanes - later, other_lanes), begin)
    moved[:] = 255
    for place in range(moved.size // other_lanes):
        here, there = place * other_lanes, place * lanes + later
        moved[here + begin : here + stop] = paths[there + begin : there + stop]
