"""Semi-global matching of a whole image: cost, aggregation and selection, row by row, on any number of threads.

One sweep runs down the image and one up; the second to reach a row finds the other's sums there and selects the row's
disparities. Meeting in the middle lets two threads share a frame: one sweeps the upper half down while the other sweeps
the lower half up, then each goes on through the other's half. No path is cut, so the result has the same bits.

The sums of a large image would not fit the memory. Then the first visit to a half leaves only the path costs at the
head of each band of rows, and before the second sweep enters a band, its sums are made again from there: exact too,
at 1.4 times the time.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from stages.data import Array
from stages.kernels.aggregation import aggregate_row
from stages.kernels.around import Windows, search_around
from stages.kernels.blank import blank_windows, drop_blank
from stages.kernels.compiled import kernel
from stages.kernels.gradient import smoothed_costs
from stages.kernels.pair import Pair, Rule, describe
from stages.kernels.selection import find_partners, find_winners, fit_row
from stages.kernels.sharing import AtOnce, by_bands, shared_by
from stages.kernels.speckles import drop_speckles
from stages.kernels.vectors import Width, lanes_in
from stages.kernels.workspace import Workspace, Workspaces

_workspaces = Workspaces()


class Matches(NamedTuple):
    """What `match` finds, (H, W) each."""

    pixels: Array  # float32, px, NaN = unknown
    source: Array  # uint8: 1 where known, else 0, as `stages.data.Source`
    confidence: Array  # float32


class Scratch(NamedTuple):
    """Rows in the making, one set for each thread."""

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


def lanes_for(disparities: int) -> int:
    """The number of lanes that hold a search range: what the processor divides well, not less than 16."""
    return next((n for n in (16, 32, 64, 96) if disparities <= n), -(-disparities // 64) * 64)


def match(
    left: Array, right: Array, rule: Rule, prior: tuple[Array, Array] | None, windows: Windows | None,
    excluded: Array | None, threads: int, memory: int,
) -> Matches:  # fmt: skip
    """Disparities of a rectified pair of gray images.

    left, right: (H, W) uint8; prior: of `prior.prior_costs`, or None; windows: where to search instead of the whole
    range, from where on the prior's costs are then meant; excluded: (H, W) bool, pixels that have no match in the
    range, or None; threads: more than 2 have nothing to do; memory: bytes that the sums of paths may take.
    """
    pixels, evidence = np.empty(left.shape, np.float32), np.empty(left.shape, np.uint8)
    both = shared_by(threads)
    with _workspaces.one() as space:
        if windows is None:
            _search_all(left, right, rule, prior, memory, pixels, evidence, space, both)
        else:
            seen = rule._replace(minimum=0)
            search_around(
                describe(left, right, seen, windows.width, prior, both), rule, windows, pixels, evidence, space, both
            )  # fmt: skip
        blank, partner = both(lambda: blank_windows(left), lambda: blank_windows(right))
        if excluded is not None:
            blank[:, : left.shape[1]] |= excluded

        def drop(first: int, end: int) -> None:
            drop_blank(*(layer[first:end] for layer in (blank, partner, pixels, evidence)))

        by_bands(both, len(left), drop)
        drop_speckles(pixels, evidence, rule.speckle_range, rule.speckle_size, space, both)
        confidence, source = np.empty(left.shape, np.float32), np.empty(left.shape, np.uint8)

        def grade(first: int, end: int) -> None:
            _grade(rule.calibration, *(layer[first:end] for layer in (evidence, confidence, source)))

        by_bands(both, len(left), grade)
    return Matches(pixels, source, confidence)


def _search_all(
    left: Array, right: Array, rule: Rule, prior: tuple[Array, Array] | None, memory: int, pixels: Array,
    evidence: Array, space: Workspace, both: AtOnce,
) -> None:  # fmt: skip
    """Fill in disparities and evidence; what that takes but the workspace is given back."""
    width = Width(lanes_for(rule.disparities))
    pair = describe(left, right, rule, width, prior, both)
    upper, lower = _halves(pair, rule, space, width, memory, pixels, evidence)
    both(upper.arrive, lower.arrive)
    both(lambda: upper.cross(lower), lambda: lower.cross(upper))


@kernel
def _grade(calibration, evidence, confidence, source):  # type: ignore[no-untyped-def]
    for y in range(evidence.shape[0]):
        for x in range(evidence.shape[1]):
            confidence[y, x] = calibration[evidence[y, x]]
            source[y, x] = evidence[y, x] > 0


@kernel
def _sweep(  # type: ignore[no-untyped-def]
    pair, rule, width, pixels, evidence, scratch, paths, y, end, step, sums, origin, final
):
    """Rows y to end (exclusive) in steps of 1 or -1; the sums of row y are at (y - origin) * W * n of `sums`."""
    size = pixels.shape[1] * lanes_in(width)
    if rule.gradient:
        for ahead in (y - step, y):  # smoothed_costs needs the column sums of two rows before it can begin
            smoothed_costs(pair, rule.unseen, ahead, scratch.column_sums, scratch.costs, width)
    while y != end:
        if rule.gradient:
            smoothed_costs(pair, rule.unseen, y + step, scratch.column_sums, scratch.costs, width)
        aggregate_row(
            pair, rule, scratch.costs, paths, y, step, sums, (y - origin) * size, scratch.total, final, width
        )  # fmt: skip
        if final:
            find_winners(
                scratch.total, scratch.beyond, scratch.guard, step, scratch.winner, scratch.votes, scratch.right, width
            )
            find_partners(scratch.winner, scratch.right, scratch.partners)
            fit_row(
                scratch.winner, scratch.votes, scratch.partners, scratch.first, rule.disparities - 1, rule, pixels[y],
                evidence[y],
            )  # fmt: skip
        y += step


def _halves(
    pair: Pair, rule: Rule, space: Workspace, width: Width, memory: int, pixels: Array, evidence: Array
) -> list[_Half]:
    """Both halves of the image, in bands whose sums take no more than `memory` bytes together."""
    height, columns = pixels.shape
    size = columns * width.lanes
    middle = height // 2
    largest = height - middle
    # Shorter bands would take more for their heads than they save.
    band = largest if 2 * largest * size <= memory else max(memory // (2 * size), math.isqrt(3 * largest))
    heads = 0 if band == largest else -(-largest // band)
    space.reserve(2 * (size * (10 + band + 3 * heads) + 64 * (8 + heads)))
    sweep = functools.partial(_sweep, pair, rule, width, pixels, evidence)
    rows = range(middle), range(height - 1, middle - 1, -1)
    return [_Half(part, band, heads > 0, space, sweep, columns, rule) for part in rows]


class _Half:
    """The rows from one end of the image to its middle, and the sweep that begins at that end."""

    def __init__(
        self, rows: range, band: int, banded: bool, space: Workspace, sweep: Callable[..., None], columns: int,
        rule: Rule,
    ) -> None:  # fmt: skip
        """rows: from the end inwards; band: how many at a time; banded: one of the halves does not fit into a band, so
        that either has its sums made again, in the memory of the sweep that crosses it."""
        lanes = lanes_for(rule.disparities)
        size = columns * lanes
        self.sweep, self.step = sweep, rows.step
        self.bands = [rows[i : i + band] for i in range(0, len(rows), band)]
        self.paths, self.again = space.bytes(3 * size), space.bytes(3 * size)
        self.sums = space.bytes(band * size)
        self.heads = [space.bytes(3 * size) for _ in self.bands] if banded else []
        index = np.uint8 if lanes <= 256 else np.uint16
        guard = np.abs(np.arange(2 * lanes) - lanes) <= 1
        self.scratch = Scratch(
            costs=space.bytes(size), column_sums=space.bytes(2 * size).reshape(2, size), total=space.bytes(size),
            winner=np.empty(columns, np.int16), votes=np.empty((4, columns), np.uint16),
            right=np.empty(columns + lanes, index), partners=np.empty(columns, np.int16),
            first=np.full(columns, rule.minimum, np.int32),
            guard=np.where(guard, np.uint8(255), np.uint8(0)),
            beyond=np.where(np.arange(lanes) < rule.disparities, np.uint8(0), np.uint8(255)),
        )  # fmt: skip

    def arrive(self) -> None:
        """Sweep to the middle. The sums stay, or else the path costs at the head of each band."""
        self.paths[:] = 0
        for i, band in enumerate(self.bands):
            if self.heads:
                self.heads[i][:] = self.paths
            self._sweep(band, self.paths, self.sums, final=False)

    def cross(self, other: _Half) -> None:
        """Sweep on from the middle to the other end, and select the disparities of that half."""
        for i, band in reversed(list(enumerate(other.bands))):
            sums = other.sums
            if other.heads:
                sums = self.sums
                self.again[:] = other.heads[i]
                self._sweep(band, self.again, sums, final=False)
            self._sweep(band[::-1], self.paths, sums, final=True)

    def _sweep(self, rows: range, paths: Array, sums: Array, final: bool) -> None:
        first, last = rows[0], rows[-1]
        self.sweep(self.scratch, paths, first, last + rows.step, rows.step, sums, min(first, last), final)
