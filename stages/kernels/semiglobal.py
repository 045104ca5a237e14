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

import cv2
import numpy as np

from stages.data import Array
from stages.kernels.aggregation import aggregate_row, brightness_steps
from stages.kernels.blank import blank_windows, drop_blank
from stages.kernels.census import census
from stages.kernels.compiled import kernel
from stages.kernels.gradient import gradients, smoothed_costs
from stages.kernels.halves import AtOnce, pairs
from stages.kernels.selection import find_winners, fit_row
from stages.kernels.speckles import drop_speckles
from stages.kernels.vectors import Width, lanes_in
from stages.kernels.workspace import Workspace, Workspaces

NO_PRIOR = np.zeros((1, 0), np.int32), np.zeros(1, np.uint8)
_workspaces = Workspaces()


class Rule(NamedTuple):
    """How to match: see `stages.Match` for the meaning of each."""

    gradient: bool  # census and gradient, or census alone
    diagonals: bool  # 8 paths, or 4
    p1: int
    table: Array  # (256,) uint8, p2 for each step of brightness
    unseen: int  # cost of a partner outside the right image
    disparities: int
    minimum: int
    uniqueness: int
    consistency: int
    speckle_range: float
    speckle_size: int
    calibration: Array  # (256,) float32, confidence for each amount of evidence


class Pair(NamedTuple):
    """What the sweeps read of the images, made once."""

    left: Array  # (H, planes, >= W) uint8: bits of census, gradients
    right: Array  # (H, planes, >= W + n) uint8: the same of the right image, backwards from the smallest disparity on
    steps: Array  # of `brightness_steps`
    outside: Array  # (W + n,) uint8: 255 where an element of `right` is outside the image
    whole_from: int  # columns for which all partners are inside
    whole_to: int
    prior: Array  # (H, W) int32: where in `prior_costs` the costs of a pixel begin; or none
    prior_costs: Array  # (m,) uint8


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
    beyond: Array
    guard: Array


def lanes_for(disparities: int) -> int:
    """The number of lanes that hold a search range: what the processor divides well, not less than 16."""
    return next((n for n in (16, 32, 64, 96) if disparities <= n), -(-disparities // 64) * 64)


def match(
    left: Array, right: Array, rule: Rule, prior: tuple[Array, Array] | None, excluded: Array | None, threads: int,
    memory: int,
) -> Matches:  # fmt: skip
    """Disparities of a rectified pair of gray images.

    left, right: (H, W) uint8; prior: of `prior.prior_costs`, or None; excluded: (H, W) bool, pixels that have no match
    in the range, or None; threads: more than 2 have nothing to do; memory: bytes that the sums of paths may take.
    """
    height, columns = left.shape
    width = Width(lanes_for(rule.disparities))
    pixels, evidence = np.empty((height, columns), np.float32), np.empty((height, columns), np.uint8)
    with pairs(threads) as both, _workspaces.one() as space:
        _sweep_all(left, right, rule, width, prior, memory, pixels, evidence, space, both)
        blank, partner = both(lambda: blank_windows(left), lambda: blank_windows(right))
        if excluded is not None:
            blank[:, :columns] |= excluded
        parts = slice(height // 2), slice(height // 2, height)
        both(*(functools.partial(drop_blank, blank[at], partner[at], pixels[at], evidence[at]) for at in parts))
        drop_speckles(pixels, evidence, rule.speckle_range, rule.speckle_size, space, both)
        confidence, source = np.empty((height, columns), np.float32), np.empty((height, columns), np.uint8)
        both(*(functools.partial(_grade, evidence[at], rule.calibration, confidence[at], source[at]) for at in parts))
    return Matches(pixels, source, confidence)


def _sweep_all(
    left: Array, right: Array, rule: Rule, width: Width, prior: tuple[Array, Array] | None, memory: int,
    pixels: Array, evidence: Array, space: Workspace, both: AtOnce,
) -> None:  # fmt: skip
    """Fill in disparities and evidence; what that takes but the workspace is given back."""
    left_planes, right_planes = both(lambda: _described(left, rule), lambda: _described(right, rule, width))
    steps = brightness_steps(left, both)
    pair = Pair(left_planes, right_planes, steps, *_view(left.shape[1], rule, width), *(prior or NO_PRIOR))
    upper, lower = _halves(pair, rule, space, width, memory, pixels, evidence)
    both(upper.arrive, lower.arrive)
    both(lambda: upper.cross(lower), lambda: lower.cross(upper))


@kernel
def _grade(evidence, calibration, confidence, source):  # type: ignore[no-untyped-def]
    for y in range(evidence.shape[0]):
        for x in range(evidence.shape[1]):
            confidence[y, x] = calibration[evidence[y, x]]
            source[y, x] = evidence[y, x] > 0


def _described(image: Array, rule: Rule, width: Width | None = None) -> Array:
    """The planes of an image; with `width` those of the right image: backwards, moved to the smallest disparity."""
    backwards, after = width is not None, 0
    if width is not None:
        before, after = max(0, -rule.minimum), max(0, rule.minimum)
        image = cv2.copyMakeBorder(cv2.flip(image, 1), 0, 0, before, after + width.lanes, cv2.BORDER_REPLICATE)
    planes = np.empty((image.shape[0], 5 if rule.gradient else 3, -(-image.shape[1] // 64) * 64), np.uint8)
    census(image, planes, backwards)
    if rule.gradient:
        gradients(image, planes, backwards)
    return planes if after == 0 else np.ascontiguousarray(planes[:, :, after:])


def _view(columns: int, rule: Rule, width: Width) -> tuple[Array, int, int]:
    """Which partners are outside the right image: `Pair.outside`, `whole_from`, `whole_to`."""
    place = np.arange(columns + width.lanes) + rule.minimum
    outside = np.where((place < 0) | (place > columns - 1), np.uint8(255), np.uint8(0))
    return outside, rule.minimum + width.lanes - 1, columns + min(0, rule.minimum)


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
            fit_row(scratch.winner, scratch.votes, scratch.right, scratch.partners, rule, pixels[y], evidence[y])
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
    return [_Half(part, band, heads > 0, space, sweep, columns, rule.disparities) for part in rows]


class _Half:
    """The rows from one end of the image to its middle, and the sweep that begins at that end."""

    def __init__(
        self, rows: range, band: int, banded: bool, space: Workspace, sweep: Callable[..., None], columns: int,
        disparities: int,
    ) -> None:  # fmt: skip
        """rows: from the end inwards; band: how many at a time; banded: one of the halves does not fit into a band, so
        that either has its sums made again, in the memory of the sweep that crosses it."""
        lanes = lanes_for(disparities)
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
            guard=np.where(guard, np.uint8(255), np.uint8(0)),
            beyond=np.where(np.arange(lanes) < disparities, np.uint8(0), np.uint8(255)),
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
