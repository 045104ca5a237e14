"""Outlier test of an organised cloud: does a point's image neighbourhood see a surface at its depth?

Distances between neighbours in space grow with the square of the range, so one threshold on them cuts away the far
ground (a k-nearest-neighbour filter at its usual settings loses most of it beyond 6 m). Inverse depth does not have
that flaw: on a plane it is linear in the pixel, its step from row to row is the same near and far, and so is its noise.
The test counts, in eight directions, the neighbours whose inverse depth differs by what noise and slope explain.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array

# Four rings of eight neighbours: rings of 1 to 4 px, so that a cloud of every 2nd, 3rd or 4th pixel has some as well.
_RINGS = 4
_DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))
OFFSETS = np.array(
    [(ring * dv, ring * du) for ring in range(1, _RINGS + 1) for dv, du in _DIRECTIONS], dtype=np.int32
)  # fmt: skip


def supported(
    points: Array,
    sigma: Array,
    pixel: Array,
    shape: tuple[int, int],
    reach: float,
    deviations: float,
    spread: float,
    share: float,
    least: int,
) -> Array:
    """Which points lie on a surface that their neighbours in the image also see.

    points: (N, 3) float32 in the camera's frame, m; sigma: (N,) float32, depth standard deviation, m; pixel: (N,)
    int32; shape: (H, W) of the image; reach: m, points farther from the camera are dropped and support nobody;
    deviations: noise a difference may show, in standard deviations; spread: slope it may show, in multiples of the
    scene's usual one; share: of the neighbours present, those that must agree; least: how many must be present.

    Returns (N,) bool.
    """
    inverse = _inverse_depth(points, pixel, int(shape[0]), int(shape[1]), float(reach))
    return _supported(  # type: ignore[no-any-return]
        points,
        sigma,
        pixel,
        inverse,
        OFFSETS,
        float(deviations),
        float(spread) * usual_slope(inverse),
        float(share),
        int(least),
        pixel_rays(points, pixel, int(shape[1])),
        float(reach),
    )


def usual_slope(inverse: Array) -> float:
    """The median change of inverse depth, 1/m, from a row to the next: the expected spacing of the ground.

    inverse: (H, W) float32, NaN = no point. Compares rows twelve apart: a multiple of every common subsampling,
    and far enough for the slope to show above the noise. 0 where no two points can be compared.
    """
    change = np.abs(inverse[12::3] - inverse[:-12:3])
    change = change[np.isfinite(change)]
    return float(np.median(change)) / 12 if len(change) else 0.0


def pixel_rays(points: Array, pixel: Array, width: int) -> Array:
    """The lines x/z = a + b * column and y/z = a + b * row that a cloud's points lie on, however many are gross errors.

    Theil-Sen: the median slope between points half a sample apart, over an evenly spaced sample of at most 4000 points.
    Returns (4,) float64, a and b of the columns, a and b of the rows; all NaN where the points do not determine them.
    """
    sample = np.linspace(0, len(points) - 1, min(len(points), 4000)).astype(np.int64)
    sample = sample[points[sample, 2] > 0] if len(points) else sample
    rays = np.full(4, np.nan)
    for axis, place in ((0, pixel[sample] % width), (1, pixel[sample] // width)):
        half = len(sample) // 2
        step = place[half : 2 * half] - place[:half]
        ratio = points[sample, axis].astype(np.float64) / points[sample, 2]
        if not np.any(step):
            return np.full(4, np.nan)
        slope = np.median((ratio[half : 2 * half] - ratio[:half])[step != 0] / step[step != 0])
        rays[2 * axis : 2 * axis + 2] = np.median(ratio - slope * place), slope
    return rays


@kernel
def _inverse_depth(points, pixel, height, width, reach):
    inverse = np.full(height * width, np.nan, np.float32)
    for i in range(points.shape[0]):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        if z > 0.0 and x * x + y * y + z * z <= reach * reach:
            inverse[pixel[i]] = 1.0 / z
    return inverse.reshape(height, width)


@kernel
def _supported(points, sigma, pixel, inverse, offsets, deviations, slope, share, least, rays, reach):
    height, width = inverse.shape
    enough = int(np.ceil(share * len(offsets)))
    keep = np.zeros(points.shape[0], np.bool_)
    for i in range(points.shape[0]):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        if not (z > 0.0 and x * x + y * y + z * z <= reach * reach):
            continue
        row = pixel[i] // width
        col = pixel[i] - row * width
        aside = 2.0 * abs(rays[1]) + 3.0 * sigma[i] / z
        if abs(x / z - rays[0] - rays[1] * col) > aside or abs(y / z - rays[2] - rays[3] * row) > aside:
            continue
        own = 1.0 / z
        noise = deviations * np.sqrt(2.0) * sigma[i] * own * own
        present = 0
        agreeing = 0
        for k in range(len(offsets)):
            r, c = row + offsets[k, 0], col + offsets[k, 1]
            if r < 0 or r >= height or c < 0 or c >= width or not inverse[r, c] > 0.0:
                continue
            present += 1
            if abs(inverse[r, c] - own) <= noise + slope * (k // 8 + 1):
                agreeing += 1
                # Enough for a full neighbourhood is enough for any: nearly every point of the ground ends here.
                if agreeing >= enough and present >= least:
                    break
        keep[i] = present >= least and agreeing >= share * present
    return keep


def supported_reference(
    points: Array,
    sigma: Array,
    pixel: Array,
    shape: tuple[int, int],
    reach: float,
    deviations: float,
    spread: float,
    share: float,
    least: int,
) -> Array:
    """The same as `supported`, in plain numpy: one image-sized shift for each neighbour."""
    p = points.astype(np.float64)
    near = (p[:, 2] > 0) & ((p**2).sum(axis=1) <= reach**2)
    inverse = np.full(shape, np.nan, np.float32)
    inverse.ravel()[pixel[near]] = 1 / p[near, 2]
    slope = spread * usual_slope(inverse)
    rays = pixel_rays(points, pixel, shape[1])
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
    return near & ~off_ray & (present >= least) & (agreeing >= share * present)  # type: ignore[no-any-return]
