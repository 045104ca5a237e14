"""Semi-global matching of a whole image: cost, aggregation and selection, row by row, on one or two threads.

One sweep runs down the image and one up. The second sweep to reach a row finds the sums of the first there, and selects
the disparities of the row. Two threads share a frame: one sweeps the upper half down while the other sweeps the lower
half up, then each continues through the other half. No path is cut, so the result has the same bits.

The sums of a large image may not fit the memory. Then the first sweep of a half keeps only the path costs at the head
of each stripe of rows. Before the second sweep enters a stripe, its sums are computed again from there, with the same
bits, in 1.4 times the time.

Each band of rows may be searched for a part of the range only (stages.matching.kernels.row_ranges).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np

from stages.compiled.jit import kernel
from stages.compiled.parallel import Fork, by_bands, shared_by
from stages.compiled.simd import Width
from stages.compiled.workspace import Workspace, Workspaces
from stages.data import Array
from stages.matching.kernels.aggregation import aggregate_row
from stages.matching.kernels.gradient import follow_slope, set_aside, smoothed_costs
from stages.matching.kernels.matching_inputs import MatchingInputs, matching_inputs
from stages.matching.kernels.row_ranges import Range, by_range, lanes_for, move_paths
from stages.matching.kernels.selection import find_partners, find_winners, fit_row, keep_costs
from stages.matching.kernels.sgm_local import SearchWindows, match_windows
from stages.matching.kernels.sgm_params import SgmParams
from stages.matching.kernels.speckles import drop_speckles
from stages.matching.kernels.texture import contrast, drop_unmatchable

_workspaces = Workspaces()
Layers = tuple[Array, Array, Array, Array]  # disparities, evidence, source, costs


class Matches(NamedTuple):
    """The result of `match`, (H, W) each."""

    pixels: Array  # float32, px, NaN = unknown
    source: Array  # uint8, codes of `PixelOrigin`
    confidence: Array  # float32
    costs: Array | None  # uint8 (2, H, W), the smallest sum of paths and that of all but its neighbours


class Scratch(NamedTuple):
    """Memory for the current row, one set for each thread and number of lanes."""

    costs: Array
    column_sums: Array
    total: Array
    winner: Array
    votes: Array
    right: Array
    partners: Array
    first: Array
    beyond: Array
    guard: Array


def match(
    left: Array, right: Array, params: SgmParams, prior: tuple[Array, ...] | None,
    search: SearchWindows | list[Range], excluded: Array | None, threads: int, max_memory: int,
) -> Matches:  # fmt: skip
    """Disparities of a rectified pair of gray images.

    Parameters
    ----------
    left, right
        (H, W) uint8.
    prior
        The result of `prior_cost.prior_costs` for the first disparity searched at each pixel, and that of
        `gradient.steep_slope` where the cost follows slopes, or None.
    search
        The disparities searched at each pixel, or in each band of rows.
    excluded
        (H, W) uint8, why a pixel has no match in the range: a code of `PixelOrigin`, or 0. None excludes no pixel.
    threads
        At most two are used.
    max_memory
        Bytes for the sums of paths.
    """
    pixels, evidence, source = (np.empty(left.shape, kind) for kind in (np.float32, np.uint8, np.uint8))
    costs = np.empty((2, *left.shape) if params.keep_costs else (2, 0, 0), np.uint8)
    layers = pixels, evidence, source, costs
    if excluded is None:
        excluded = np.empty((0, 0), np.uint8)
    run_both = shared_by(threads)
    with _workspaces.one() as space:
        if isinstance(search, SearchWindows):
            from_zero = params._replace(min_disparity=0)
            inputs = matching_inputs(left, right, from_zero, search.width, prior, run_both)
            match_windows(inputs, params, search, layers, space, run_both)
        else:
            _match_ranges(left, right, params, prior, search, max_memory, layers, space, run_both)

        def drop(first: int, end: int) -> None:
            rows = (layer[first:end] for layer in (excluded, pixels, evidence, source))
            drop_unmatchable(contrast(left, first, end), contrast(right, first, end), *rows)

        by_bands(run_both, len(left), drop)
        drop_speckles(pixels, evidence, source, params.max_speckle_size, space, run_both)
    return Matches(pixels, source, cv2.LUT(evidence, params.confidence_of), costs if params.keep_costs else None)


def _match_ranges(
    left: Array, right: Array, params: SgmParams, prior: tuple[Array, ...] | None, ranges: list[Range],
    max_memory: int, layers: Layers, space: Workspace, run_both: Fork,
) -> None:  # fmt: skip
    """Write disparities, evidence and source into `layers`; memory outside the workspace is freed on return."""
    inputs = matching_inputs(left, right, params, Width(lanes_for(params.disparities)), prior, run_both)
    upper, lower = _halves(inputs, params, space, ranges, max_memory, layers)
    run_both(upper.arrive, lower.arrive)
    run_both(lambda: upper.cross(lower), lambda: lower.cross(upper))


@kernel
def _sweep(inputs, params, layers, width, scratch, first_lane, top, paths, y, end, step, sums, origin, stride, final):
    """Rows y to end (exclusive) in steps of 1 or -1; the sums of row y are at (y - origin) * stride of `sums`."""
    pixels, evidence, source, costs = layers
    for ahead in (y - step, y):  # smoothed_costs needs the column sums of two rows before it can begin
        smoothed_costs(inputs, params.unseen_cost, first_lane, ahead, scratch.column_sums, scratch.costs, width)
    while y != end:
        ahead, here = scratch.column_sums[y + step & 1], scratch.column_sums[y & 1]
        slope = inputs.slope[y if inputs.slope.size > 0 else 0]
        set_aside(slope, step, ahead, scratch.total, width)
        smoothed_costs(inputs, params.unseen_cost, first_lane, y + step, scratch.column_sums, scratch.costs, width)
        follow_slope(slope, step, scratch.total, ahead, here, scratch.costs, width)
        place = (y - origin) * stride
        aggregate_row(inputs, params, scratch.costs, paths, y, step, sums, place, scratch.total, final, width)
        if final:
            find_winners(
                scratch.total, scratch.beyond, scratch.guard, scratch.winner, scratch.votes, scratch.right, width
            )
            find_partners(scratch.winner, scratch.right, scratch.partners)
            fit_row(
                scratch.winner, scratch.votes, scratch.partners, scratch.first, top, params, pixels[y], evidence[y],
                source[y],
            )  # fmt: skip
            keep_costs(scratch.votes, costs, y)
        y += step


def _halves(
    inputs: MatchingInputs,
    params: SgmParams,
    space: Workspace,
    ranges: list[Range],
    max_memory: int,
    layers: Layers,
) -> list[_Half]:
    """Both halves of the image, in stripes whose sums take at most `max_memory` bytes together."""
    height, columns = layers[0].shape
    size = columns * max(each.width.lanes for each in ranges)
    middle = height // 2
    largest = height - middle
    # Shorter stripes would need more memory for their heads than they save.
    stripe = largest if 2 * largest * size <= max_memory else max(max_memory // (2 * size), math.isqrt(3 * largest))
    heads = 0 if stripe == largest else -(-largest // stripe)
    moves = 2 if len(ranges) > 1 else 0  # of paths, from one range to another
    space.reserve(2 * (size * (10 + stripe + 3 * (heads + moves)) + 64 * (8 + heads + moves)))
    sweep = functools.partial(_sweep, inputs, params, layers)
    rows = range(middle), range(height - 1, middle - 1, -1)
    return [_Half(part, stripe, heads > 0, space, sweep, ranges, columns, params) for part in rows]


class _Paths:
    """The costs of the paths of a sweep, for the disparity range of its current row."""

    def __init__(self, space: Workspace, size: int, moves: bool) -> None:
        """size: bytes of a row; moves: whether there are several ranges."""
        self.whole, self.spare = space.bytes(3 * size), space.bytes(3 * size) if moves else None
        self.at: Range | None = None

    def begin(self) -> None:
        """Set all costs to 0: at the border of the image all paths begin."""
        self.whole[:], self.at = 0, None

    def take(self, other: _Paths) -> None:
        """Copy the costs of another sweep."""
        self.whole[:], self.at = other.whole, other.at

    def enter(self, at: Range, columns: int) -> Array:
        """The costs, (3 * W * n,) uint8, moved to the range `at` of n lanes."""
        lanes, size = at.width.lanes, 3 * columns * at.width.lanes
        if self.spare is not None and self.at is not None and (at.first, at.width) != (self.at.first, self.at.width):
            move_paths(self.whole, self.at.width.lanes, at.first - self.at.first, self.spare[:size], lanes)
            self.whole, self.spare = self.spare, self.whole
        self.at = at
        return self.whole[:size]


class _Half:
    """The rows from one end of the image to its middle, and the sweep that begins at that end."""

    def __init__(
        self, rows: range, stripe: int, striped: bool, space: Workspace, sweep: Callable[..., None],
        ranges: list[Range], columns: int, params: SgmParams,
    ) -> None:  # fmt: skip
        """rows: from the border inwards; stripe: rows of a stripe; striped: a half does not fit into one stripe, so the
        sums of both are computed again, in the memory of the sweep that crosses."""
        widths = {each.width.lanes for each in ranges}
        self.sweep, self.ranges, self.columns, self.minimum = sweep, ranges, columns, params.min_disparity
        self.size = size = columns * max(widths)
        self.stripes = [rows[i : i + stripe] for i in range(0, len(rows), stripe)]
        self.paths, self.again = (_Paths(space, size, len(ranges) > 1) for _ in range(2))
        self.sums = space.bytes(stripe * size)
        self.heads = [_Paths(space, size, False) for _ in self.stripes] if striped else []
        rows_of_bytes = space.bytes(size), space.bytes(2 * size), space.bytes(size)
        self.scratch = {lanes: _scratch(lanes, columns, params.disparities, *rows_of_bytes) for lanes in widths}
        self.tops = {lanes: min(lanes, params.disparities) - 1 for lanes in widths}

    def arrive(self) -> None:
        """Sweep to the middle. Keep the sums, or in stripes the path costs at the head of each stripe."""
        self.paths.begin()
        for i, stripe in enumerate(self.stripes):
            if self.heads:
                self.heads[i].take(self.paths)
            self._sweep(stripe, self.paths, self.sums, final=False)

    def cross(self, other: _Half) -> None:
        """Continue from the middle through the other half, and select its disparities."""
        for i, stripe in reversed(list(enumerate(other.stripes))):
            sums = other.sums
            if other.heads:
                sums = self.sums
                self.again.take(other.heads[i])
                self._sweep(stripe, self.again, sums, final=False)
            self._sweep(stripe[::-1], self.paths, sums, final=True)

    def _sweep(self, rows: range, paths: _Paths, sums: Array, final: bool) -> None:
        origin = min(rows[0], rows[-1])
        for part, at in by_range(rows, self.ranges):
            lanes = at.width.lanes
            scratch = self.scratch[lanes]
            scratch.first[:] = self.minimum + at.first
            self.sweep(
                at.width, scratch, at.first, self.tops[lanes], paths.enter(at, self.columns), part[0],
                part[-1] + part.step, part.step, sums, origin, self.size, final,
            )  # fmt: skip


def _scratch(lanes: int, columns: int, disparities: int, costs: Array, column_sums: Array, total: Array) -> Scratch:
    """Rows of `lanes` lanes in the given memory: W * lanes bytes, twice as many, and as many."""
    size = columns * lanes
    index = np.uint8 if lanes <= 256 else np.uint16
    guard = np.abs(np.arange(2 * lanes) - lanes) <= 1
    return Scratch(
        costs=costs[:size], column_sums=column_sums[: 2 * size].reshape(2, size), total=total[:size],
        winner=np.empty(columns, np.int16), votes=np.empty((4, columns), np.uint16),
        right=np.empty(columns + lanes, index), partners=np.empty(columns, np.int16),
        first=np.empty(columns, np.int32),
        guard=np.where(guard, np.uint8(255), np.uint8(0)),
        beyond=np.where(np.arange(lanes) < disparities, np.uint8(0), np.uint8(255)),
    )  # fmt: skip
