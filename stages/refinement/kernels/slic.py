"""SLIC superpixels (Achanta et al., 2012; section 3.2 of the paper): k-means over colour and position.

Each pixel is compared with the nine centres around its grid cell. The centres of a grid row are expanded to rows of
pixels once, so that the inner loop runs over whole image rows without a branch. The centres move at half resolution,
for a quarter of the work; the last assignment uses the full image. A wide image is halved before: planes need no finer
edges. Connected components are found by runs of pixels in a row, not pixel by pixel.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from stages.compiled.jit import fast_kernel, fast_part, kernel, part
from stages.compiled.parallel import Fork, in_turn, shared_by
from stages.compiled.union_find import join, root
from stages.compiled.workspace import Workspaces
from stages.data import Array
from stages.matching.kernels.resample import halved

F32 = np.float32
_workspaces = Workspaces()
COMPACTNESS = 10.0  # weight of position against colour, CIELAB units at one grid step
LIGHTNESS_SCALE = F32(100 / 255)  # from 8 bits to L in 0..100
NO_CENTRE = F32(1e30)
ITERATIONS = 2  # of the centres, before the last assignment
TILE = 64  # pixels of a row whose nearest centres are found together
MIN_HALVED_CELL = 8  # px; with smaller grid cells the centres move at full resolution
MIN_HALVED_WIDTH = 960  # px; superpixels of a wider image have edges of 2 px


def superpixels(image: Array, count: int, threads: int = 1) -> tuple[Array, int]:
    """Segment an image into about `count` connected superpixels.

    image: (H, W) gray or (H, W, 3) RGB, uint8. Returns the labels, (H, W) int32 in 0..n-1, and n.
    """
    height, width = image.shape[:2]
    count = min(count, height * width)
    step = math.sqrt(height * width / count)
    grid = max(1, round(height / step)), max(1, round(width / step))
    roomy = min(height // grid[0], width // grid[1]) >= MIN_HALVED_CELL and min(height, width) > 1
    small = halved(image[: height // 2 * 2, : width // 2 * 2]) if roomy else image
    if roomy and width >= MIN_HALVED_WIDTH:
        labels, total = superpixels(small, count, threads)
        labels = labels.repeat(2, axis=1).repeat(2, axis=0)
        odd = (0, height % 2), (0, width % 2)
        return (np.pad(labels, odd, mode="edge") if labels.shape != (height, width) else labels), total
    both, colour = shared_by(threads), _colours(image)
    small = _colours(small) if roomy else colour
    centres = _grid_centres(small, *grid)
    for _ in range(ITERATIONS):
        _move_centres(small, centres, grid, COMPACTNESS / step * (2 if roomy else 1), both)
    if roomy:
        centres[:, 3:] = centres[:, 3:] * 2 + F32(0.5)
    labels = _labels(colour, centres, grid, COMPACTNESS / step, both)
    with _workspaces.one() as space:
        space.reserve(12 * height * width + 64)
        total = int(connect(labels, int(0.25 * height * width / count), space.array((3, height * width), np.int32)))
    return labels, total


def _colours(image: Array) -> Array:
    """The image in CIELAB with 8 bits each, (H, W, 3) uint8; a gray one as it is, (H, W, 1)."""
    return image[..., None].copy() if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2LAB)


def _grid_centres(colour: Array, rows: int, cols: int) -> Array:
    """Start centres (rows * cols, 5) float32: three colours (L in 0..100; of gray the second and third 0), y, x."""
    height, width, channels = colour.shape
    y, x = np.meshgrid((np.arange(rows) + 0.5) * height / rows, (np.arange(cols) + 0.5) * width / cols, indexing="ij")
    centres = np.zeros((rows * cols, 5), np.float32)
    centres[:, :channels] = colour[y.astype(int).ravel(), x.astype(int).ravel()]
    centres[:, 0] *= LIGHTNESS_SCALE
    centres[:, 3], centres[:, 4] = y.ravel(), x.ravel()
    return centres


def _move_centres(colour: Array, centres: Array, grid: tuple[int, int], weight: float, both: Fork) -> None:
    """One k-means step: each centre becomes the mean of its pixels."""
    labels = _labels(colour, centres, grid, weight, both)
    sums = np.zeros((len(centres), 6))
    add_pixels(colour, labels, LIGHTNESS_SCALE, sums)
    seen = sums[:, 5] > 0
    centres[seen] = sums[seen, :5] / sums[seen, 5:]


def _labels(colour: Array, centres: Array, grid: tuple[int, int], weight: float, both: Fork = in_turn) -> Array:
    """The nearest centre of each pixel, (H, W) int32."""
    rows, cols = grid
    labels = np.empty(colour.shape[:2], np.int32)
    square, middle = F32(weight**2), rows // 2
    both(
        lambda: _assign(colour, centres, rows, cols, square, 0, middle, labels),
        lambda: _assign(colour, centres, rows, cols, square, middle, rows, labels),
    )
    return labels


@fast_kernel
def _assign(colour, centres, rows, cols, position_weight, first_row, end_row, labels):
    """Find the nearest of nine centres for the pixels of grid rows first_row to end_row."""
    height, width, channels = colour.shape
    work, col = np.zeros((4 + 9 * 5) * TILE, np.float32), np.empty(width, np.int32)
    for k in range(cols):
        col[k * width // cols : (k + 1) * width // cols] = k
    centre_rows = np.empty((9, 5, width), np.float32)
    for row in range(first_row, end_row):
        for place in range(9):
            _expand_row(centres, rows, cols, row + place // 3 - 1, place % 3 - 1, position_weight, centre_rows[place])
        for start in range(0, width, TILE):
            size = min(TILE, width - start)
            for place in range(9):
                for i in range(5):
                    at = (4 + 5 * place + i) * TILE
                    work[at : at + size] = centre_rows[place, i, start : start + size]
            for y in range(row * height // rows, (row + 1) * height // rows):
                pixels = colour[y, start : start + size]
                for x in range(size):
                    work[x] = F32(pixels[x, 0]) * LIGHTNESS_SCALE
                if channels == 3:
                    for x in range(size):
                        work[TILE + x], work[2 * TILE + x] = pixels[x, 1], pixels[x, 2]
                _find_nearest(work, F32(y), position_weight)
                own, middle = labels[y, start : start + size], col[start : start + size]
                for x in range(size):
                    nearest = np.int32(work[3 * TILE + x])
                    own[x] = (row + nearest // 3 - 1) * cols + middle[x] + nearest % 3 - 1


@fast_part
def _find_nearest(work, y, position_weight):
    """Write which of nine centres is nearest to each of TILE pixels of row y, 0 to 8, behind their three colours.

    Five layers of each centre follow. All are in one array at constant distances: so the compiler knows that they do
    not overlap and vectorises.
    """
    for x in range(TILE):
        first, second, third = work[x], work[TILE + x], work[2 * TILE + x]
        least, nearest = NO_CENTRE, F32(0)
        for place in range(9):
            at = (4 + 5 * place) * TILE + x
            da, db, dc = first - work[at], second - work[at + TILE], third - work[at + 2 * TILE]
            dy = y - work[at + 3 * TILE]
            d = da * da + db * db + dc * dc + dy * dy * position_weight + work[at + 4 * TILE]
            nearest = F32(place) if d < least else nearest
            least = d if d < least else least
        work[3 * TILE + x] = nearest


@kernel
def add_pixels(colour, labels, scale, sums):
    """Add colour, y, x and 1 of each pixel to the `sums` of its label, (n, 6) float64.

    scale: of the first channel; of a gray image the second and third are not added.
    """
    height, width, channels = colour.shape
    for y in range(height):
        for x in range(width):
            total = sums[labels[y, x]]
            total[0] += F32(colour[y, x, 0]) * scale
            if channels == 3:
                total[1] += colour[y, x, 1]
                total[2] += colour[y, x, 2]
            total[3] += y
            total[4] += x
            total[5] += 1


@fast_part
def _expand_row(centres, rows, cols, row, beside, position_weight, laid):
    """laid, (5, W), becomes colour, y and weighted squared x distance of each pixel's candidate centre.

    The candidate is in grid row `row`, `beside` the pixel's own grid column; `NO_CENTRE` without such a centre.
    """
    width = laid.shape[1]
    for col in range(cols):
        start, stop = col * width // cols, (col + 1) * width // cols
        if 0 <= row < rows and 0 <= col + beside < cols:
            k = row * cols + col + beside
            for i in range(4):
                laid[i, start:stop] = centres[k, i]
            for x in range(start, stop):
                dx = F32(x) - centres[k, 4]
                laid[4, x] = dx * dx * position_weight
        else:
            laid[:4, start:stop] = 0
            laid[4, start:stop] = NO_CENTRE


@kernel
def connect(labels, min_size, scratch):
    """Number the 4-connected components of `labels` (H, W) int32 in scan order, in place; returns how many.

    scratch: (3, H * W) int32. A component of fewer than `min_size` pixels joins the one left of its first pixel, or
    above it at the left border.
    """
    # For each run of equal labels in a row: its end, an earlier run of its component, and its component's number.
    ends, parent, number = scratch[0], scratch[1], scratch[2]
    rows = np.empty((labels.shape[0], 2), np.int64)  # first run of each row, and one past the last
    _join_runs(labels, rows, ends, parent)
    total = _number(min_size, rows, ends, parent, number)
    for y in range(labels.shape[0]):
        start = 0
        for run in range(rows[y, 0], rows[y, 1]):
            of_all = number[parent[run]]
            for x in range(start, ends[run]):
                labels[y, x] = of_all
            start = ends[run]
    return total


@part
def _join_runs(labels, rows, ends, parent):
    """Find the runs and join those of a component."""
    width, run = labels.shape[1], np.int64(0)
    for y in range(labels.shape[0]):
        rows[y, 0], row = run, labels[y]
        for x in range(1, width):  # without a branch, which nothing predicts
            ends[run], parent[run] = x, run
            run += np.int64(row[x] != row[x - 1])
        ends[run], parent[run] = width, run
        run += np.int64(1)
        rows[y, 1] = run
        if y > 0:
            _join(labels, y, rows, ends, parent)


@part
def _join(labels, y, rows, ends, parent):
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


@part
def _number(min_size, rows, ends, parent, number):
    """Set each run's parent to its root and number the components; returns their count."""
    for y in range(rows.shape[0]):
        start = 0
        for run in range(rows[y, 0], rows[y, 1]):
            first = root(parent, run)
            parent[run] = first
            if first == run:
                number[run] = 0
            number[first] += ends[run] - start  # first the size
            start = ends[run]
    total = np.int32(0)
    for y in range(rows.shape[0]):  # a root is the first run of its component: earlier runs have their numbers
        for run in range(rows[y, 0], rows[y, 1]):
            if parent[run] != run:
                continue
            if number[run] < min_size and run > 0:
                before = run - 1 if run > rows[y, 0] else rows[y - 1, 0]
                number[run] = number[parent[before]]
            else:
                number[run] = total
                total += np.int32(1)
    return total


def assign_reference(colour: Array, centres: Array, rows: int, cols: int, position_weight: float) -> Array:
    """`_assign` in plain numpy: the nearest of the nine centres around each pixel's grid cell."""
    height, width, channels = colour.shape
    values = np.zeros((height, width, 3))
    values[..., :channels] = colour
    values[..., 0] = colour[..., 0] * LIGHTNESS_SCALE
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
            distance = ((values - centre[..., :3]) ** 2).sum(axis=2)
            distance += ((y - centre[..., 3]) ** 2 + (x - centre[..., 4]) ** 2) * position_weight
            closer = inside & (distance < best)
            best[closer], labels[closer] = distance[closer], k[closer]
    return labels


def connect_reference(labels: Array, min_size: int) -> tuple[Array, int]:
    """`connect` by scikit-image's components: the numbers, (H, W) int32, and their count."""
    from skimage import measure  # takes long to import

    height, width = labels.shape
    component = measure.label(labels, background=-1, connectivity=1)  # type: ignore[no-untyped-call]
    numbers, total = np.full((height, width), -1, np.int32), 0
    for y, x in np.ndindex(height, width):
        if numbers[y, x] >= 0:
            continue
        same = component == component[y, x]
        if same.sum() < min_size and (y, x) != (0, 0):
            numbers[same] = numbers[y, x - 1] if x > 0 else numbers[y - 1, x]
        else:
            numbers[same], total = total, total + 1
    return numbers, total
