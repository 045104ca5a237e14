"""SLIC superpixels (Achanta et al., 2012; section 3.2 of the paper): k-means over colour and position.

Each pixel looks only at the nine centres around its own grid cell, so all pixels of a cell share their candidates and
the inner loop runs over a short row of pixels with one centre in registers. The centres settle at half resolution, at
a quarter of the work; the last assignment is of the full image. What is not connected then is found by runs of pixels
in a row, not pixel by pixel.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from stages.data import Array
from stages.kernels.compiled import fast_kernel, kernel
from stages.kernels.halves import AtOnce, in_turn, pairs
from stages.kernels.scaling import halved
from stages.kernels.union import join, root
from stages.kernels.workspace import Workspaces

F32 = np.float32
_workspaces = Workspaces()
LEAST_CELL = 8  # px; where grid cells are smaller, the centres settle at full resolution


def superpixels(
    image: Array, count: int, compactness: float = 10.0, iterations: int = 3, threads: int = 1
) -> tuple[Array, int]:
    """Segment an image into about `count` connected superpixels.

    image: (H, W) gray or (H, W, 3) RGB, uint8; compactness: weight of position against colour, in CIELAB units at one
    grid step; iterations: all but the last at half resolution, where the image is large enough; threads: 2 share the
    work, to the same result. Returns the labels, (H, W) int32 in 0..n-1, and n.
    """
    height, width = image.shape[:2]
    count = min(count, height * width)
    step = math.sqrt(height * width / count)
    grid = max(1, round(height / step)), max(1, round(width / step))
    smallest = int(0.25 * height * width / count)
    with pairs(threads) as both, _workspaces.one() as space:
        space.reserve(28 * height * width + 4096)
        colour = _colour_planes(image, space.array((3, height, width), np.float32), both)
        scale = 2 if min(height // grid[0], width // grid[1]) >= LEAST_CELL and min(height, width) > 1 else 1
        small = colour
        if scale == 2:
            half = halved(image[: height // 2 * 2, : width // 2 * 2])
            small = _colour_planes(half, space.array((3, *half.shape[:2]), np.float32), both)
        centres = _grid_centres(small, *grid)
        for _ in range(iterations - 1):
            _move(small, centres, grid, compactness / step * scale, both)
        if scale == 2:
            centres[:, 3:] = centres[:, 3:] * 2 + F32(0.5)
        labels = _labels(colour, centres, grid, compactness / step, both)[0]
        total = connect(labels, smallest, space.array((3, height * width), np.int32), both)
    return labels, total


def _move(colour: Array, centres: Array, grid: tuple[int, int], weight: float, both: AtOnce) -> None:
    """One k-means step: `centres` becomes the means of what is nearest to each."""
    sums = _labels(colour, centres, grid, weight, both)[1]
    seen = sums[:, 5] > 0
    centres[seen] = sums[seen, :5] / sums[seen, 5:]


def _labels(colour: Array, centres: Array, grid: tuple[int, int], weight: float, both: AtOnce) -> tuple[Array, Array]:
    """The nearest centre of each pixel, (H, W) int32, and the sums of `_assign`."""
    rows, cols = grid
    labels = np.empty(colour.shape[1:], np.int32)
    upper, lower = np.zeros((2, rows * cols, 6))
    square, middle = F32(weight**2), rows // 2
    both(
        lambda: _assign(colour, centres, rows, cols, square, 0, middle, labels, upper),
        lambda: _assign(colour, centres, rows, cols, square, middle, rows, labels, lower),
    )
    return labels, upper + lower


def _colour_planes(image: Array, planes: Array, both: AtOnce = in_turn) -> Array:
    """`planes`, (3, H, W) float32, with the image in CIELAB (L in 0..100); a gray image has a = b = 0."""
    middle = image.shape[0] // 2
    both(
        lambda: _fill_colour_planes(image[:middle], planes[:, :middle]),
        lambda: _fill_colour_planes(image[middle:], planes[:, middle:]),
    )
    return planes


def _fill_colour_planes(image: Array, planes: Array) -> None:
    if image.size == 0:
        return
    channels = [image] if image.ndim == 2 else cv2.split(cv2.cvtColor(image, cv2.COLOR_RGB2LAB))
    planes[len(channels) :] = 0
    for plane, channel, scale in zip(planes, channels, (100 / 255, 1.0, 1.0), strict=False):
        np.multiply(channel, F32(scale), out=plane)


def _grid_centres(colour: Array, rows: int, cols: int) -> Array:
    """Start centres (rows * cols, 5) float32: three colours, y, x."""
    _, height, width = colour.shape
    y, x = np.meshgrid((np.arange(rows) + 0.5) * height / rows, (np.arange(cols) + 0.5) * width / cols, indexing="ij")
    centres = np.empty((rows * cols, 5), np.float32)
    centres[:, :3] = colour[:, y.astype(int).ravel(), x.astype(int).ravel()].T
    centres[:, 3], centres[:, 4] = y.ravel(), x.ravel()
    return centres


@fast_kernel
def _assign(colour, centres, rows, cols, position_weight, first_row, end_row, labels, sums):  # type: ignore[no-untyped-def]
    """Label the pixels of grid rows first_row to end_row with the nearest of nine centres.

    sums: (rows * cols, 6) float64, to which colour, y, x and count of each label are added.
    """
    _, height, width = colour.shape
    first, second, third = colour[0], colour[1], colour[2]
    best = np.empty(width, np.float32)
    nearest = np.empty(width, np.int32)
    for row in range(first_row, end_row):
        for y in range(row * height // rows, (row + 1) * height // rows):
            for col in range(cols):
                start, stop = col * width // cols, (col + 1) * width // cols
                n = stop - start
                a, b, c = first[y, start:stop], second[y, start:stop], third[y, start:stop]
                distances, winners = best[:n], nearest[:n]
                distances[:] = F32(1e30)
                for near_row in range(max(0, row - 1), min(rows, row + 2)):
                    for near_col in range(max(0, col - 1), min(cols, col + 2)):
                        k = np.int32(near_row * cols + near_col)
                        ka, kb, kc = centres[k, 0], centres[k, 1], centres[k, 2]
                        dy = F32(y) - centres[k, 3]
                        dy2 = dy * dy * position_weight
                        x0 = F32(start) - centres[k, 4]
                        for i in range(n):
                            da, db, dc, dx = a[i] - ka, b[i] - kb, c[i] - kc, x0 + F32(np.int32(i))
                            d = da * da + db * db + dc * dc + dx * dx * position_weight + dy2
                            closer = d < distances[i]
                            distances[i] = d if closer else distances[i]
                            winners[i] = k if closer else winners[i]
                for i in range(n):
                    k = winners[i]
                    labels[y, start + i] = k
                    sums[k, 0] += a[i]
                    sums[k, 1] += b[i]
                    sums[k, 2] += c[i]
                    sums[k, 3] += y
                    sums[k, 4] += start + i
                    sums[k, 5] += 1


def connect(labels: Array, smallest: int, scratch: Array, both: AtOnce = in_turn) -> int:
    """Number the 4-connected components of `labels` (H, W) int32 in scan order, in place; returns how many.

    scratch: (3, H * W) int32, to work in. One of fewer than `smallest` pixels joins the component left of its first
    pixel, or above it at the left border.
    """
    height = labels.shape[0]
    middle = height // 2
    # Of each run of equal labels in a row: where it ends, a run of its component before it, and its component's number.
    ends, parent, number = scratch
    rows = np.empty((height, 2), np.int64)  # the first run of each row, and the first beyond
    both(
        lambda: _join_runs(labels, 0, middle, rows, ends, parent),
        lambda: _join_runs(labels, middle, height, rows, ends, parent),
    )
    total = int(_number(labels, middle, smallest, rows, ends, parent, number))
    both(
        lambda: _write(labels, 0, middle, rows, ends, parent, number),
        lambda: _write(labels, middle, height, rows, ends, parent, number),
    )
    return total


@kernel
def _join(labels, y, rows, ends, parent):  # type: ignore[no-untyped-def]
    """Join the runs of row y with those of equal label in the row above; the earliest run becomes the root."""
    width = labels.shape[1]
    run, run_above = rows[y, 0], rows[y - 1, 0]
    here = above = 0
    while here < width and above < width:
        if labels[y, here] == labels[y - 1, above]:
            join(parent, run, run_above)
        end, end_above = ends[run], ends[run_above]
        if end <= end_above:
            here = end
            run += 1
        if end_above <= end:
            above = end_above
            run_above += 1


@kernel
def _join_runs(labels, first, end, rows, ends, parent):  # type: ignore[no-untyped-def]
    """Find the runs of rows first to end and join those of a component; they are numbered from first * W."""
    width = labels.shape[1]
    run = first * width
    for y in range(first, end):
        rows[y, 0] = run
        for x in range(1, width + 1):
            if x == width or labels[y, x] != labels[y, x - 1]:
                ends[run] = x
                parent[run] = run
                run += 1
        rows[y, 1] = run
        if y > first:
            _join(labels, y, rows, ends, parent)


@kernel
def _number(labels, middle, smallest, rows, ends, parent, number):  # type: ignore[no-untyped-def]
    """The parent of every run becomes its root, which gets the number of its component; returns how many."""
    height = labels.shape[0]
    if 0 < middle < height:
        _join(labels, middle, rows, ends, parent)
    for y in range(height):
        start = 0
        for run in range(rows[y, 0], rows[y, 1]):
            first = root(parent, run)
            parent[run] = first
            if first == run:
                number[run] = 0
            number[first] += ends[run] - start  # its size, at first
            start = ends[run]
    total = np.int32(0)
    for y in range(height):  # a root is the first run of its component: what lies before it has its number already
        for run in range(rows[y, 0], rows[y, 1]):
            if parent[run] != run:
                continue
            if number[run] < smallest and run > 0:
                before = run - 1 if run > rows[y, 0] else rows[y - 1, 0]
                number[run] = number[parent[before]]
            else:
                number[run] = total
                total += np.int32(1)
    return total


@kernel
def _write(labels, first, end, rows, ends, parent, number):  # type: ignore[no-untyped-def]
    for y in range(first, end):
        start = 0
        for run in range(rows[y, 0], rows[y, 1]):
            of_all = number[parent[run]]
            for x in range(start, ends[run]):
                labels[y, x] = of_all
            start = ends[run]


def assign_reference(colour: Array, centres: Array, rows: int, cols: int, position_weight: float) -> Array:
    """What `_assign` labels, in plain numpy: the nearest of the nine centres around each pixel's grid cell."""
    _, height, width = colour.shape
    y, x = np.mgrid[:height, :width]
    row_edges = np.arange(1, rows) * height // rows
    col_edges = np.arange(1, cols) * width // cols
    row, col = np.searchsorted(row_edges, y, side="right"), np.searchsorted(col_edges, x, side="right")
    best, labels = np.full((height, width), np.inf), np.zeros((height, width), np.int32)
    for down in (-1, 0, 1):
        for across in (-1, 0, 1):
            r, c = row + down, col + across
            inside = (r >= 0) & (r < rows) & (c >= 0) & (c < cols)
            k = np.where(inside, r * cols + c, 0)
            centre = centres[k].astype(np.float64)
            distance = ((colour.transpose(1, 2, 0) - centre[..., :3]) ** 2).sum(axis=2)
            distance += ((y - centre[..., 3]) ** 2 + (x - centre[..., 4]) ** 2) * position_weight
            closer = inside & (distance < best)
            best[closer], labels[closer] = distance[closer], k[closer]
    return labels


def connect_reference(labels: Array, smallest: int) -> tuple[Array, int]:
    """`connect` by scipy's components, label after label: the numbers, (H, W) int32, and how many."""
    from scipy import ndimage

    height, width = labels.shape
    component = np.zeros((height, width), np.int64)
    for label in np.unique(labels):
        found, _ = ndimage.label(labels == label)
        component = np.where(found > 0, found + component.max(), component)
    numbers, total = np.full((height, width), -1, np.int32), 0
    for y, x in np.ndindex(height, width):
        if numbers[y, x] >= 0:
            continue
        same = component == component[y, x]
        if same.sum() < smallest and (y, x) != (0, 0):
            numbers[same] = numbers[y, x - 1] if x > 0 else numbers[y - 1, x]
        else:
            numbers[same], total = total, total + 1
    return numbers, total
