"""Merges superpixels into regions of even colour, a larger support for planes.

It is SLIC of superpixels instead of pixels: each is one point, its mean colour and position, weighted by its size. A
region may be in pieces, but it follows image edges because its superpixels do.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array
from stages.refinement.kernels.slic import COMPACTNESS, add_pixels

ITERATIONS = 3


def merge_regions(image: Array, labels: Array, count: int, groups: int) -> tuple[Array, int]:
    """Merge superpixels into about `groups` regions.

    image: (H, W) gray or (H, W, 3) RGB, uint8; labels: (H, W) int32 in 0..count-1. Returns the region of each
    superpixel, (count,) int32 in 0..n-1, and n.
    """
    height, width = image.shape[:2]
    step = math.sqrt(height * width / min(groups, count))
    rows, cols = max(1, round(height / step)), max(1, round(width / step))
    points, size = _superpixel_points(image, labels, count, COMPACTNESS / step)
    home = np.floor(points[:, 3:] / (COMPACTNESS / step) * [rows / height, cols / width]).astype(int)
    nearest = _nearest_cells(points, size, np.minimum(home, [rows - 1, cols - 1]), rows, cols)
    used, region = np.unique(nearest, return_inverse=True)
    return region.astype(np.int32), len(used)


def _superpixel_points(image: Array, labels: Array, count: int, scale: float) -> tuple[Array, Array]:
    """Mean colour (CIELAB, L in 0..100), y and x times `scale`, (count, 5), and size, (count,), of each superpixel."""
    sums = np.zeros((count, 6))
    add_pixels(image.reshape(*labels.shape, -1), labels, np.float32(1), sums)
    if image.ndim == 2:
        sums[:, 1:3] = sums[:, :1]
    means = sums[:, :5] / sums[:, 5:]
    rgb = np.clip(np.rint(means[None, :, :3]), 0, 255).astype(np.uint8)
    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB)[0] * [100 / 255, 1, 1]
    return np.concatenate([lab, (means[:, 3:] + 0.5) * scale], axis=1), sums[:, 5]


@kernel
def _nearest_cells(points, size, home, rows, cols):
    """The nearest grid cell (n,) of each point (n, 5), among the nine around its own cell (n, 2)."""
    count = len(points)
    nearest = home[:, 0] * cols + home[:, 1]
    centres, mass = np.empty((rows * cols, 5)), np.empty(rows * cols)
    for _ in range(ITERATIONS):
        centres[:] = 0
        mass[:] = 0
        for s in range(count):
            mass[nearest[s]] += size[s]
            for i in range(5):
                centres[nearest[s], i] += size[s] * points[s, i]
        for k in range(rows * cols):
            for i in range(5):
                centres[k, i] /= max(mass[k], 1.0)
        for s in range(count):
            best = np.inf
            for row in range(max(home[s, 0] - 1, 0), min(home[s, 0] + 2, rows)):
                for col in range(max(home[s, 1] - 1, 0), min(home[s, 1] + 2, cols)):
                    k = row * cols + col
                    distance = 0.0
                    for i in range(5):
                        distance += (points[s, i] - centres[k, i]) ** 2
                    if mass[k] > 0 and distance < best:
                        best, nearest[s] = distance, k
    return nearest


def merge_regions_reference(image: Array, labels: Array, count: int, groups: int) -> tuple[Array, int]:
    """`merge_regions` in plain numpy, superpixel after superpixel."""
    height, width = image.shape[:2]
    step = math.sqrt(height * width / min(groups, count))
    rows, cols = max(1, round(height / step)), max(1, round(width / step))
    points, sizes, home = np.empty((count, 5)), np.empty(count), np.empty((count, 2), int)
    for s in range(count):
        y, x = np.nonzero(labels == s)
        colour = np.broadcast_to(image[y, x].reshape(len(y), -1), (len(y), 3)).astype(np.int64)
        rgb = np.rint(colour.sum(axis=0) / len(y)).astype(np.uint8)
        points[s, :3] = cv2.cvtColor(rgb[None, None], cv2.COLOR_RGB2LAB)[0, 0] * [100 / 255, 1, 1]
        place = np.array([y.sum() / len(y), x.sum() / len(x)]) + 0.5
        points[s, 3:], sizes[s] = place * (COMPACTNESS / step), len(y)
        place = points[s, 3:] / (COMPACTNESS / step)
        home[s] = np.minimum(np.floor(place * [rows / height, cols / width]), [rows - 1, cols - 1])
    nearest = home[:, 0] * cols + home[:, 1]
    for _ in range(ITERATIONS):
        members = [nearest == k for k in range(rows * cols)]
        centres = [(points[m] * sizes[m, None]).sum(axis=0) / sizes[m].sum() if m.any() else None for m in members]
        for s in range(count):
            around = [(home[s, 0] + down, home[s, 1] + across) for down in (-1, 0, 1) for across in (-1, 0, 1)]
            inside = [r * cols + c for r, c in around if 0 <= r < rows and 0 <= c < cols]
            reached = [k for k in inside if centres[k] is not None]
            nearest[s] = min(reached, key=lambda k: ((points[s] - centres[k]) ** 2).sum())
    used, region = np.unique(nearest, return_inverse=True)
    return region.astype(np.int32), len(used)
