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
MAX_DEVIATIONS = 3.0  # standard deviations of noise between two neighbours of one surface
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
    rays = pixel_rays(points, pixel, chosen, int(shape[1]))
    kept = np.empty(len(chosen), np.int64)
    kept = kept[: _keep(points, sigma, pixel, chosen, agreed.reshape(-1), rays, inverse[inside], kept)]
    return kept, inverse[inside], tolerance[inside]


def write_depths(
    points: Array, sigma: Array, pixel: Array, chosen: Array, max_range: float, inverse: Array, tolerance: Array
) -> None:
    """Write the inverse depths of the points `chosen`, 1/m, and the differences that noise explains, into two images.

    points: (N, 3) float32 in the camera's frame, m; sigma: (N,) float32, depth standard deviation, m; pixel: (N,)
    int32; chosen: (M,) int64; max_range: m from the camera, of the points that are written; into inverse, tolerance:
    (H, W) float32.
    """
    _write_depths(points, sigma, pixel, chosen, MAX_DEVIATIONS * np.sqrt(2.0), float(max_range), inverse, tolerance)


def median_slope(inverse: Array) -> float:
    """The median change of inverse depth, 1/m, from one row to the next; 0 without two points to compare.

    inverse: (H, W) float32, NaN = no point. Rows twelve apart are compared, which is far enough for the slope to exceed
    the noise; of every 4th row and column, so that a cloud of these has the same slope.
    """
    change = np.abs(inverse[12::4, ::4] - inverse[:-12:4, ::4])
    change = change[np.isfinite(change)]
    return float(np.median(change)) / 12 if len(change) else 0.0


def pixel_rays(points: Array, pixel: Array, chosen: Array, width: int) -> Array:
    """The lines x/z = a + b * column and y/z = a + b * row on which a cloud's points lie, robust to gross errors.

    Theil-Sen: the median slope between points half a sample apart, over an evenly spaced sample of at most 4000 of the
    `chosen` points. Returns (4,) float64, a and b of the columns, a and b of the rows; all NaN if the points do not
    determine them.
    """
    sample = chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), 4000)).astype(np.int64)]
    sample = sample[points[sample, 2] > 0]
    rays = np.full(4, np.nan)
    for axis, index in ((0, pixel[sample] % width), (1, pixel[sample] // width)):
        half = len(sample) // 2
        step = index[half : 2 * half] - index[:half]
        ratio = points[sample, axis].astype(np.float64) / points[sample, 2]
        if not np.any(step):
            return np.full(4, np.nan)
        slope = np.median((ratio[half : 2 * half] - ratio[:half])[step != 0] / step[step != 0])
        rays[2 * axis : 2 * axis + 2] = np.median(ratio - slope * index), slope
    return rays


@kernel
def _write_depths(points, sigma, pixel, chosen, factor, max_range, inverse, tolerance):
    width = inverse.shape[1]
    for i in chosen:
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        if z > 0.0 and x * x + y * y + z * z <= max_range * max_range:
            row = pixel[i] // width
            col = pixel[i] - row * width
            own = 1.0 / z
            inverse[row, col], tolerance[row, col] = own, factor * sigma[i] * own * own


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
def _keep(points, sigma, pixel, chosen, agreed, rays, inverse, kept):
    """Keep the points that agree and lie on their pixel's line of sight, erase the others, and return their number."""
    width = inverse.shape[1]
    count = 0
    for i in chosen:
        row = pixel[i] // width
        col = pixel[i] - row * width
        own = 1.0 / np.float64(points[i, 2])
        aside = 2.0 * abs(rays[1]) + 3.0 * sigma[i] * own
        across = abs(points[i, 0] * own - rays[0] - rays[1] * col)
        down = abs(points[i, 1] * own - rays[2] - rays[3] * row)
        if agreed[pixel[i]] and not (across > aside or down > aside):
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
    rays = pixel_rays(points, pixel, np.arange(len(points)), shape[1])
    row, col = np.divmod(pixel, shape[1])
    own = 1 / np.where(near, p[:, 2], np.nan)
    aside = 2 * abs(rays[1]) + 3 * sigma * own
    off_ray = np.abs(p[:, 0] * own - rays[0] - rays[1] * col) > aside
    off_ray |= np.abs(p[:, 1] * own - rays[2] - rays[3] * row) > aside
    padded = np.pad(inverse, RINGS, constant_values=np.nan)
    present, agreeing = np.zeros(len(p), int), np.zeros(len(p), int)
    for k, (dv, du) in enumerate(OFFSETS):
        difference = np.abs(padded[row + dv + RINGS, col + du + RINGS] - own)
        present += np.isfinite(difference)
        agreeing += difference <= MAX_DEVIATIONS * np.sqrt(2) * sigma * own**2 + slope * (k // 8 + 1)
    agreed = (present >= MIN_NEIGHBOURS) & (agreeing >= MIN_AGREEING_SHARE * present)
    return chosen[near & ~off_ray & agreed]  # type: ignore[no-any-return]
