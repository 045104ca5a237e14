"""Bridges holes that both cameras see by a straight line between their ends along the row.

Holes are filled from the background (`holes`), because most of them are hidden from the right camera. The flank of a
boulder leaves a hole as well: its disparity changes too fast for the windows of a match. A hidden hole is as wide as
the step of disparity between its ends. Of a wider hole the right camera sees a part, so the images can decide: where
they contradict the background and fit the line better, the hole takes the line. That is a guess, never a measurement.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel, part
from stages.data import Array
from stages.refinement.kernels.holes import BRIDGE, KEPT, MIN_SURFACE_STEP, OCCLUSION, OPEN

F32 = np.float32
MIN_LENGTH = 4  # px, of a hole; in a shorter one the images decide little
MIN_SEEN_LENGTH = 2.0  # px, of a hole in the right image; matches end a little before the edge of what is hidden
MIN_CHANGE = 1.0  # px between the line and the background
MIN_CONTRADICTION = 6  # mean gray levels between the images, well above noise
MAX_DIFFERENCE = np.int64(20)  # gray levels; a pixel that differs more counts no more
RADIUS = 1  # rows above and below whose images count
PARTS = np.int64(16)  # of a pixel; whole numbers sum to the same in any order


@part
def _difference(left, right, y, x, disparity):
    """The difference of the images at a pixel and in `RADIUS` rows around it, in `PARTS` of a gray level."""
    height, width = left.shape
    place = np.int64(min(max(F32(PARTS) * (F32(x) - disparity), F32(0)), F32(PARTS * (width - 1) - 1)))
    column, share = place // PARTS, place % PARTS
    total = np.int64(0)
    for row in range(y - RADIUS, y + RADIUS + 1):
        inside = min(max(row, 0), height - 1)
        there = (PARTS - share) * np.int64(right[inside, column]) + share * np.int64(right[inside, column + 1])
        difference = abs(PARTS * np.int64(left[inside, x]) - there)
        total += difference if difference < PARTS * MAX_DIFFERENCE else PARTS * MAX_DIFFERENCE
    return total


@part
def _on_line(before, after, steps, length):
    return before + (after - before) * F32(steps) / F32(length + 1)


@part
def _is_bridge(disparity, left, right, y, first, end, filled, kinds):
    """Whether the hole in columns `first` to `end` - 1 takes the line between its ends."""
    before, after, length = disparity[y, first - 1], disparity[y, end], end - first
    if abs(after - before) < F32(MIN_SURFACE_STEP) or F32(length) - (after - before) < F32(MIN_SEEN_LENGTH):
        return False
    change, by_fill, by_line, seen = F32(0), np.int64(0), np.int64(0), 0
    for x in range(first, end):
        if kinds[y, x] == OPEN:
            return False
        line = _on_line(before, after, x - first + 1, length)
        change = max(change, abs(line - filled[y, x]))
        by_line += _difference(left, right, y, x, line)
        if kinds[y, x] != OCCLUSION:
            by_fill += _difference(left, right, y, x, filled[y, x])
            seen += 1
    contradicted = by_fill > MIN_CONTRADICTION * PARTS * (2 * RADIUS + 1) * seen
    return change >= F32(MIN_CHANGE) and contradicted and by_line * seen < by_fill * length


@kernel
def bridge_holes(disparity, filled, kinds, left, right):
    """`filled` and `kinds` with bridges, which have the kind `BRIDGE`; both arrays are changed.

    disparity: (H, W) float32, px, NaN = hole; filled, kinds: as `fill_holes` returns them; left, right: (H, W) uint8.
    """
    height, width = disparity.shape
    for y in range(height):
        x = 1
        while x < width:
            if kinds[y, x] == KEPT or kinds[y, x - 1] != KEPT:
                x += 1
                continue
            first = x
            while x < width and kinds[y, x] != KEPT:
                x += 1
            if x == width or x - first < MIN_LENGTH:
                continue
            if _is_bridge(disparity, left, right, y, first, x, filled, kinds):
                for i in range(first, x):
                    filled[y, i] = _on_line(disparity[y, first - 1], disparity[y, x], i - first + 1, x - first)
                    kinds[y, i] = BRIDGE
    return filled, kinds


def bridge_holes_reference(
    disparity: Array, filled: Array, kinds: Array, left: Array, right: Array
) -> tuple[Array, Array]:
    """`bridge_holes` in plain numpy, with copies."""
    filled, kinds = filled.copy(), kinds.copy()
    padded = [np.pad(image.astype(int), ((RADIUS, RADIUS), (0, 0)), mode="edge") for image in (left, right)]
    for y, row in enumerate(disparity):
        left_rows, right_rows = (image[y : y + 2 * RADIUS + 1] for image in padded)
        borders = np.flatnonzero(np.diff(kinds[y] != KEPT))
        if kinds[y, 0] != KEPT:
            borders = borders[1:]
        for before, last in zip(borders[::2], borders[1::2], strict=False):
            columns = np.arange(before + 1, last + 1)
            ends, length = row[[before, last + 1]], F32(len(columns))
            step = ends[1] - ends[0]
            line = ends[0] + step * (columns - before).astype(F32) / (length + 1)
            background, seen = filled[y, columns], kinds[y, columns] != OCCLUSION
            if (
                length < MIN_LENGTH
                or abs(step) < MIN_SURFACE_STEP
                or length - step < MIN_SEEN_LENGTH
                or (kinds[y, columns] == OPEN).any()
                or abs(line - background).max() < MIN_CHANGE
                or not seen.any()
            ):
                continue
            by_fill = _differences_reference(left_rows, right_rows, columns[seen], background[seen]).mean()
            by_line = _differences_reference(left_rows, right_rows, columns, line).mean()
            if by_fill > MIN_CONTRADICTION * PARTS and by_line < by_fill:
                filled[y, columns], kinds[y, columns] = line, BRIDGE
    return filled, kinds


def _differences_reference(left: Array, right: Array, columns: Array, disparity: Array) -> Array:
    """Differences of rows of the images, (rows, n) int, in `PARTS` of a gray level."""
    last = PARTS * (right.shape[1] - 1) - 1
    place = np.clip((F32(PARTS) * (columns.astype(F32) - disparity)).astype(int), 0, last)
    column, share = place // PARTS, place % PARTS
    there = (PARTS - share) * right[:, column] + share * right[:, column + 1]
    differences: Array = np.minimum(abs(PARTS * left[:, columns] - there), PARTS * MAX_DIFFERENCE)
    return differences
