"""Outlier test of an organised cloud: do a point's neighbours in the image lie on a surface at its depth?

Distances in space grow with the square of the range, so a threshold on them removes the far ground. On a plane, inverse
depth is linear in the pixel: its step from row to row and its noise are the same near and far. The test counts, in
eight directions, the neighbours whose inverse depth differs by no more than noise and slope explain.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array

# Eight neighbours in each of four rings of 1 to 4 px, so that a cloud of every 4th pixel has neighbours too.
RINGS = 4
_DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))
OFFSETS = np.array(
    [(ring * dv, ring * du) for ring in range(1, RINGS + 1) for dv, du in _DIRECTIONS], dtype=np.int32
)  # fmt: skip
EXPLAINED = 3.0 * np.sqrt(2.0)  # standard deviations of noise between two neighbours of one surface
MAX_SLOPE_RATIO = 2.0  # steepest slope of a surface over the scene's median slope
MIN_AGREEING_SHARE = 0.3  # of the up to 32 neighbours in the image
MIN_NEIGHBOURS = 4  # with fewer a point cannot be judged and is dropped


def supported(
    points: Array, sigma: Array, pixel: Array, chosen: Array, shape: tuple[int, int], max_range: float
) -> tuple[Array, Array, Array]:
    """The points that lie on the same surface as enough of their neighbours in the image, of those `chosen`.

    points: (N, 3) float32 in the camera's frame, m; sigma: (N,) float32, depth standard deviation, m; pixel: (N,)
    int32; chosen: (M,) int64, indices; shape: (H, W) of the image; max_range: m from the camera, farther points are
    dropped and support no other. Returns indices, (K,) int64, and the images of `write_depths` that contain these
    points only, (H, W) float32 each.
    """
    inverse, tolerance = (np.full((shape[0] + 2 * RINGS, shape[1] + 2 * RINGS), x, np.float32) for x in (np.nan, 0))
    inside = np.s_[RINGS:-RINGS, RINGS:-RINGS]
    write_depths(points, sigma, pixel, chosen, max_range, inverse[inside], tolerance[inside])
    slope = np.float32(MAX_SLOPE_RATIO * median_slope(inverse[inside]))
    agreed = np.zeros(shape, np.bool_)
    _agree(inverse, tolerance, OFFSETS, slope, np.float32(MIN_AGREEING_SHARE), agreed)
    kept = np.empty(len(chosen), np.int64)
    return kept[: _keep(pixel, chosen, agreed, inverse[inside], kept)], inverse[inside], tolerance[inside]


@kernel
def write_depths(points, sigma, pixel, chosen, max_range, inverse, tolerance):
    """Write the inverse depths of the points `chosen`, 1/m, and the differences that noise explains, into two images.

    points: (N, 3) float32 in the camera's frame, m; sigma: (N,) float32, depth standard deviation, m; pixel: (N,)
    int32; chosen: (M,) int64; max_range: float, m from the camera, of the points that are written; into inverse,
    tolerance: (H, W) float32.
    """
    width = inverse.shape[1]
    for i in chosen:
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        if z > 0.0 and x * x + y * y + z * z <= max_range * max_range:
            row = pixel[i] // width
            col = pixel[i] - row * width
            own = 1.0 / z
            inverse[row, col], tolerance[row, col] = own, EXPLAINED * sigma[i] * own * own


def median_slope(inverse: Array) -> float:
    """The median change of inverse depth, 1/m, from one row to the next; 0 without two points to compare.

    inverse: (H, W) float32, NaN = no point. Rows twelve apart are compared, which is far enough for the slope to exceed
    the noise; of every 4th row and column, so that a cloud of these has the same slope.
    """
    change = np.abs(inverse[12::4, ::4] - inverse[:-12:4, ::4])
    change = change[np.isfinite(change)]
    return float(np.median(change)) / 12 if len(change) else 0.0


@kernel
def _agree(inverse, tolerance, offsets, slope, share, agreed):
    """Whether enough of the neighbours of each pixel agree; a row at a time, so that all its pixels share the work."""
    height, width = agreed.shape
    filled = np.zeros(inverse.shape[0], np.bool_)
    for row in range(inverse.shape[0]):
        filled[row] = (inverse[row] > np.float32(0)).any()
    present, agreeing = np.empty((2, width), np.float32)
    for row in range(height):
        if not filled[row + RINGS]:
            continue
        own, noise = inverse[row + RINGS, RINGS:], tolerance[row + RINGS, RINGS:]
        present[:] = agreeing[:] = 0
        for k in range(len(offsets)):
            there = row + RINGS + offsets[k, 0]
            if filled[there]:
                beside, more = inverse[there, RINGS + offsets[k, 1] :], slope * np.float32(k // 8 + 1)
                for x in range(width):
                    apart = abs(beside[x] - own[x])  # NaN without one of the two
                    present[x] += np.float32(1) if apart >= 0 else np.float32(0)
                    agreeing[x] += np.float32(1) if apart <= noise[x] + more else np.float32(0)
        for x in range(width):
            agreed[row, x] = (present[x] >= MIN_NEIGHBOURS) & (agreeing[x] >= share * present[x])


@kernel
def _keep(pixel, chosen, agreed, inverse, kept):
    """Keep the points that agree, erase the others, and return the number kept."""
    width, count = inverse.shape[1], 0
    for i in chosen:
        row = pixel[i] // width
        col = pixel[i] - row * width
        if agreed[row, col]:
            kept[count] = i
            count += 1
        else:
            inverse[row, col] = np.nan
    return count


def supported_reference(
    points: Array, sigma: Array, pixel: Array, chosen: Array, shape: tuple[int, int], max_range: float
) -> Array:
    """The same as `supported`, in plain numpy: one image-sized shift for each neighbour."""
    points, sigma, pixel = points[chosen], sigma[chosen], pixel[chosen]
    p = points.astype(np.float64)
    near = (p[:, 2] > 0) & ((p**2).sum(axis=1) <= max_range**2)
    inverse = np.full(shape, np.nan, np.float32)
    inverse.ravel()[pixel[near]] = 1 / p[near, 2]
    slope = MAX_SLOPE_RATIO * median_slope(inverse)
    row, col = np.divmod(pixel, shape[1])
    own = 1 / np.where(near, p[:, 2], np.nan)
    padded = np.pad(inverse, RINGS, constant_values=np.nan)
    present, agreeing = np.zeros(len(p), int), np.zeros(len(p), int)
    for k, (dv, du) in enumerate(OFFSETS):
        difference = np.abs(padded[row + dv + RINGS, col + du + RINGS] - own)
        present += np.isfinite(difference)
        agreeing += difference <= EXPLAINED * sigma * own**2 + slope * (k // 8 + 1)
    agreed = (present >= MIN_NEIGHBOURS) & (agreeing >= MIN_AGREEING_SHARE * present)
    kept: Array = chosen[near & agreed]
    return kept
