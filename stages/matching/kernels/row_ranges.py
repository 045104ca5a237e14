"""Search ranges of bands of rows: a row of a rover's image shows ground at similar distances, so its range is small.

Each band is searched for the disparities of a prior in it, plus a margin; where the prior knows little of a band, for
those of it and of the bands around it. Ranges differ in their first disparity and in their number of lanes. Between two
bands the costs of the paths are moved to the lanes that have the same disparities in the other band; disparities of one
band only count as "not searched".
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from stages.compiled.jit import kernel
from stages.compiled.simd import Width
from stages.data import Array, PixelOrigin

MEASURED = int(PixelOrigin.MEASURED)
RANGE_MARGIN = 8  # px to either side of the prior's disparities in a band
OUTLIER_SHARE = 0.001  # of the prior of a range, at either end, is ignored: less than a speckle
MIN_KNOWN_SHARE = 0.5  # of a band's pixels; with fewer known pixels, as in the sky, the bands around it count too
NARROW_LANES = (64, 96, 128)  # of ranges shorter than the whole; each number is compiled at its first use


class Range(NamedTuple):
    """The search range of rows top to end (exclusive)."""

    top: int
    end: int
    first: int  # its first disparity, less the smallest of the whole range
    width: Width


def lanes_for(disparities: int) -> int:
    """The number of lanes for a search range: at least 16, and a size that suits the processor."""
    return next((n for n in (16, 32, 64, 96) if disparities <= n), -(-disparities // 64) * 64)


def whole_range(rows: int, disparities: int) -> list[Range]:
    """One band: all rows are searched for all disparities."""
    return [Range(0, rows, 0, Width(lanes_for(disparities)))]


def row_ranges(prior: Array, height: int, minimum: int, disparities: int) -> list[Range]:
    """The bands of an image, of `height` rows each, and their ranges.

    prior: (H, W) float32, px, NaN = unknown; minimum, disparities: px, the whole range.
    """
    rows, columns = prior.shape
    cuts = [*range(0, rows, height), rows]
    counts = np.zeros((len(cuts) - 1, disparities), np.int64)
    for (top, end), number in zip(itertools.pairwise(cuts), counts, strict=True):
        _count(prior[top:end], minimum, number)
    most, ranges = lanes_for(disparities), []
    for i, (top, end) in enumerate(itertools.pairwise(cuts)):
        enough = MIN_KNOWN_SHARE * (end - top) * columns
        around = (counts[max(i - reach, 0) : i + reach + 1].sum(axis=0) for reach in range(len(counts)))
        up_to = np.cumsum(next((number for number in around if number.sum() >= enough), counts[i]))
        ignored = int(OUTLIER_SHARE * up_to[-1])
        low, high = np.searchsorted(up_to, [ignored, up_to[-1] - ignored - 1], side="right").tolist()
        low, high = max(low - RANGE_MARGIN, 0), min(high + RANGE_MARGIN, disparities - 1)
        needed = high - low + 1
        lanes = next((n for n in NARROW_LANES if needed <= n < most), most)
        if lanes == most or up_to[-1] < enough:
            ranges.append(Range(top, end, 0, Width(most)))
        else:
            first = low - (lanes - needed) // 2
            ranges.append(Range(top, end, min(max(first, 0), disparities - lanes), Width(lanes)))
    return ranges


def by_range(rows: range, ranges: list[Range]) -> Iterator[tuple[range, Range]]:
    """The parts of `rows` that lie in one range each, in the order of `rows`."""
    low, high = min(rows[0], rows[-1]), max(rows[0], rows[-1])
    for each in ranges if rows.step > 0 else reversed(ranges):
        part = range(max(low, each.top), min(high + 1, each.end))
        if part:
            yield part[:: rows.step], each


@kernel
def _count(prior, minimum, counts):
    """Add the histogram of the disparities; those beyond the range count at its end."""
    last = np.float32(counts.size - 1)
    for y in range(prior.shape[0]):
        for x in range(prior.shape[1]):
            place = np.rint(prior[y, x]) - np.float32(minimum)
            if np.isfinite(place):
                counts[np.int64(min(max(place, np.float32(0)), last))] += 1


@kernel
def count_in_rows(pixels, source, near, reach):
    """The pixels of each row below `near`, the known ones, and those measured above `reach`: (3, H) int64.

    pixels: (H, W) float32, px, NaN = unknown; source: (H, W) uint8, codes of `PixelOrigin`; near, reach: float32.
    """
    counts = np.zeros((3, pixels.shape[0]), np.int64)
    for y in range(pixels.shape[0]):
        far, known, reached = np.int32(0), np.int32(0), np.int32(0)
        for x in range(np.uint64(pixels.shape[1])):
            d = pixels[y, x]
            far += np.int32(d < near)
            known += np.int32(np.isfinite(d))
            reached += np.int32((d > reach) & (source[y, x] == MEASURED))
        counts[0, y], counts[1, y], counts[2, y] = far, known, reached
    return counts


def count_in_rows_reference(pixels: Array, source: Array, near: np.float32, reach: np.float32) -> Array:
    """`count_in_rows`, in plain numpy."""
    layers = pixels < near, np.isfinite(pixels), (pixels > reach) & (source == MEASURED)
    return np.array([np.count_nonzero(layer, axis=1) for layer in layers])


@kernel
def move_paths(paths, lanes, later, moved, other_lanes):
    """Move the costs of paths to a range that begins `later` px farther and has `other_lanes`.

    Disparities that only the new range has get 255, not searched.
    """
    begin = min(max(-later, 0), other_lanes)
    stop = max(min(lanes - later, other_lanes), begin)
    moved[:] = 255
    for place in range(moved.size // other_lanes):
        here, there = place * other_lanes, place * lanes + later
        moved[here + begin : here + stop] = paths[there + begin : there + stop]
