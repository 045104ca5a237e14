"""Outlier test of an organised cloud: do a point's neighbours in the image lie on a surface at its depth?

Distances in space grow with the square of the range, so a threshold on them removes the far ground. On a plane, inverse
depth is linear in the pixel: its step from row to row and its noise are the same near and far. The test counts, in
eight directions, the neighbours whose inverse depth differs by no more than noise and slope explain.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array

# Eight neighbours in each of four rings of 1 to 4 px, so that a cloud of every 4th pixel has neighbours too.
_RINGS = 4
_DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))
OFFSETS = np.array(
    [(ring * dv, ring * du) for ring in range(1, _RINGS + 1) for dv, du in _DIRECTIONS], dtype=np.int32
)  # fmt: skip


class SupportRule(NamedTuple):
    """When a point is supported by its neighbours."""

    max_depth_range: float  # m from the camera; farther points are dropped and support no other
    max_deviations: float  # standard deviations of noise in a difference of inverse depth
    max_slope_ratio: float  # slope of a surface over the scene's median slope
    min_agreeing_share: float  # of the neighbours present
    min_neighbours: int  # present


def supported(
    points: Array, sigma: Array, pixel: Array, chosen: Array, shape: tuple[int, int], rule: SupportRule
) -> Array:
    """The points that lie on the same surface as enough of their neighbours in the image, of those `chosen`.

    points: (N, 3) float32 in the camera's frame, m; sigma: (N,) float32, depth standard deviation, m; pixel: (N,)
    int32; chosen: (M,) int64, indices; shape: (H, W) of the image. Returns indices, (K,) int64.
    """
    inverse = np.full((shape[0] + 2 * _RINGS, shape[1] + 2 * _RINGS), np.nan, np.float32)
    _inverse_depth(points, pixel, chosen, int(shape[1]), rule.max_depth_range, inverse)
    slope = rule.max_slope_ratio * median_slope(inverse[_RINGS:-_RINGS, _RINGS:-_RINGS])
    rays = pixel_rays(points, pixel, chosen, int(shape[1]))
    offsets = OFFSETS[:, 0] * inverse.shape[1] + OFFSETS[:, 1]
    return _supported(  # type: ignore[no-any-return]
        points, sigma, pixel, chosen, inverse, offsets.astype(np.int64), rule, slope, rays
    )


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
def _inverse_depth(points, pixel, chosen, width, max_range, inverse):
    """Write the inverse depth of the points within the range into an image with a border."""
    for i in chosen:
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        if z > 0.0 and x * x + y * y + z * z <= max_range * max_range:
            row = pixel[i] // width
            inverse[row + _RINGS, pixel[i] - row * width + _RINGS] = 1.0 / z


@kernel
def _supported(points, sigma, pixel, chosen, inverse, offsets, rule, slope, rays):
    max_range, deviations, _, share, least = rule
    stride = inverse.shape[1]
    width = stride - 2 * _RINGS
    flat = inverse.reshape(-1)
    enough = int(np.ceil(share * len(offsets)))
    keep = np.empty(chosen.size, np.int64)
    kept = 0
    for i in chosen:
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        if not (z > 0.0 and x * x + y * y + z * z <= max_range * max_range):
            continue
        row = pixel[i] // width
        col = pixel[i] - row * width
        own = 1.0 / z
        aside = 2.0 * abs(rays[1]) + 3.0 * sigma[i] * own
        if abs(x * own - rays[0] - rays[1] * col) > aside or abs(y * own - rays[2] - rays[3] * row) > aside:
            continue
        noise = deviations * np.sqrt(2.0) * sigma[i] * own * own
        here = (row + _RINGS) * stride + col + _RINGS
        present = 0
        agreeing = 0
        for k in range(len(offsets)):
            beside = flat[here + offsets[k]]
            if not beside > 0.0:
                continue
            present += 1
            if abs(beside - own) <= noise + slope * (k // 8 + 1):
                agreeing += 1
                # Enough for a full neighbourhood is enough for any. Nearly every ground point ends here.
                if agreeing >= enough and present >= least:
                    break
        if present >= least and agreeing >= share * present:
            keep[kept] = i
            kept += 1
    return keep[:kept]


def supported_reference(
    points: Array, sigma: Array, pixel: Array, chosen: Array, shape: tuple[int, int], rule: SupportRule
) -> Array:
    """The same as `supported`, in plain numpy: one image-sized shift for each neighbour."""
    max_range, deviations, slope_ratio, share, least = rule
    points, sigma, pixel = points[chosen], sigma[chosen], pixel[chosen]
    p = points.astype(np.float64)
    near = (p[:, 2] > 0) & ((p**2).sum(axis=1) <= max_range**2)
    inverse = np.full(shape, np.nan, np.float32)
    inverse.ravel()[pixel[near]] = 1 / p[near, 2]
    slope = slope_ratio * median_slope(inverse)
    rays = pixel_rays(points, pixel, np.arange(len(points)), shape[1])
    row, col = np.divmod(pixel, shape[1])
    own = 1 / np.where(near, p[:, 2], np.nan)
    aside = 2 * abs(rays[1]) + 3 * sigma * own
    off_ray = np.abs(p[:, 0] * own - rays[0] - rays[1] * col) > aside
    off_ray |= np.abs(p[:, 1] * own - rays[2] - rays[3] * row) > aside
    padded = np.pad(inverse, _RINGS, constant_values=np.nan)
    present, agreeing = np.zeros(len(p), int), np.zeros(len(p), int)
    for k, (dv, du) in enumerate(OFFSETS):
        difference = np.abs(padded[row + dv + _RINGS, col + du + _RINGS] - own)
        present += np.isfinite(difference)
        agreeing += difference <= deviations * np.sqrt(2) * sigma * own**2 + slope * (k // 8 + 1)
    return chosen[near & ~off_ray & (present >= least) & (agreeing >= share * present)]  # type: ignore[no-any-return]
