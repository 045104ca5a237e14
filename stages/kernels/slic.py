"""SLIC superpixels (Achanta et al., 2012; section 3.2 of the paper): k-means over colour and position.

Each pixel looks only at the nine centres around its own grid cell, so all pixels of a cell share their candidates and
the inner loop runs over a short row of pixels with one centre in registers. A flood fill makes the labels connected.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numba import njit

from stages.data import Array

F32 = np.float32


def superpixels(image: Array, count: int, compactness: float = 10.0, iterations: int = 5) -> tuple[Array, int]:
    """Segment an image into about `count` connected superpixels.

    image: (H, W) gray or (H, W, 3) RGB, uint8; compactness: weight of position against colour, in CIELAB units at one
    grid step. Returns the labels, (H, W) int32 in 0..n-1, and n.
    """
    height, width = image.shape[:2]
    count = min(count, height * width)
    step = math.sqrt(height * width / count)
    rows, cols = max(1, round(height / step)), max(1, round(width / step))
    colour = _colour_planes(image)
    centres = _grid_centres(colour, rows, cols)
    labels = np.empty((height, width), np.int32)
    sums = np.empty((rows * cols, 6), np.float64)
    for _ in range(iterations):
        _assign(colour, centres, rows, cols, F32((compactness / step) ** 2), labels, sums)
        seen = sums[:, 5] > 0
        centres[seen] = sums[seen, :5] / sums[seen, 5:]
    smallest = int(0.25 * height * width / count)
    connected = np.full((height, width), -1, np.int32)
    total = _connect(labels, smallest, connected, np.empty(height * width, np.int32))
    return connected, int(total)


def _colour_planes(image: Array) -> Array:
    """The image as (3, H, W) float32 CIELAB planes (L in 0..100); a gray image has a = b = 0."""
    planes = np.zeros((3, *image.shape[:2]), np.float32)
    if image.ndim == 2:
        np.multiply(image, F32(100 / 255), out=planes[0])
        return planes
    lab = cv2.cvtColor(image, cv2.COLOR_RGB2LAB)
    for plane, channel, scale in zip(planes, cv2.split(lab), (100 / 255, 1.0, 1.0), strict=True):
        np.multiply(channel, F32(scale), out=plane)
    return planes


def _grid_centres(colour: Array, rows: int, cols: int) -> Array:
    """Start centres (rows * cols, 5) float32: three colours, y, x."""
    _, height, width = colour.shape
    y, x = np.meshgrid((np.arange(rows) + 0.5) * height / rows, (np.arange(cols) + 0.5) * width / cols, indexing="ij")
    centres = np.empty((rows * cols, 5), np.float32)
    centres[:, :3] = colour[:, y.astype(int).ravel(), x.astype(int).ravel()].T
    centres[:, 3], centres[:, 4] = y.ravel(), x.ravel()
    return centres


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _assign(colour, centres, rows, cols, position_weight, labels, sums):  # type: ignore[no-untyped-def]
    """One k-means step: label every pixel with the nearest of nine centres; sum colour, y, x and count per label."""
    _, height, width = colour.shape
    first, second, third = colour[0], colour[1], colour[2]
    best = np.empty(width, np.float32)
    nearest = np.empty(width, np.int32)
    sums[:] = 0
    for row in range(rows):
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


@njit(nogil=True, cache=True)
def _connect(labels, smallest, connected, queue):  # type: ignore[no-untyped-def]
    """Number the 4-connected components in scan order; one below `smallest` px joins the component before it."""
    height, width = labels.shape
    source, target = labels.ravel(), connected.ravel()
    total = np.int32(0)
    for seed in range(height * width):
        if target[seed] >= 0:
            continue
        label = source[seed]
        before = np.int32(-1)
        if seed % width > 0:
            before = target[seed - 1]
        elif seed >= width:
            before = target[seed - width]
        queue[0] = seed
        target[seed] = total
        head, tail = 0, 1
        while head < tail:
            at = queue[head]
            head += 1
            x = at % width
            if x > 0 and target[at - 1] < 0 and source[at - 1] == label:
                target[at - 1] = total
                queue[tail] = at - 1
                tail += 1
            if x < width - 1 and target[at + 1] < 0 and source[at + 1] == label:
                target[at + 1] = total
                queue[tail] = at + 1
                tail += 1
            if at >= width and target[at - width] < 0 and source[at - width] == label:
                target[at - width] = total
                queue[tail] = at - width
                tail += 1
            if at + width < height * width and target[at + width] < 0 and source[at + width] == label:
                target[at + width] = total
                queue[tail] = at + width
                tail += 1
        if tail < smallest and before >= 0:
            for i in range(tail):
                target[queue[i]] = before
        else:
            total += 1
    return total


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
