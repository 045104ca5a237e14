"""Splats: copies of points along their lines of sight, as far as their depth is uncertain.

Far from the camera the depth of a pixel is uncertain by a cell or more, so the cell that receives the point is chance.
Copies on both sides of the point reach all candidate cells.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array, Transform

OFFSETS = np.array([-1.0, -0.5, 0.5, 1.0])  # of the copies, as shares of the reach


def splat_along_ray(
    points: Array, sigma: Array, sensor: Transform, sigmas: float, min_reach: float, max_reach: float
) -> tuple[Array, Array]:
    """Four copies of each point that reaches at least `min_reach`, m of depth, to either side.

    points: (N, 3) float32, m; sigma: (N,) float32, depth standard deviation, m; sensor: the camera in the points'
    frame; sigmas: reach in standard deviations; max_reach: m, a longer reach is cut. Returns the copies, (4 M, 3)
    float32, and their sigma, (4 M,) float32.
    """
    chosen = np.flatnonzero(sigma * np.float32(sigmas) >= np.float32(min_reach))
    copies, copied_sigma = np.empty((len(OFFSETS) * len(chosen), 3), np.float32), sigma[chosen].repeat(len(OFFSETS))
    camera = sensor.translation, sensor.rotation[:, 2].copy()
    _splat(points, sigma, chosen, camera, sigmas, max_reach, OFFSETS, copies)
    return copies, copied_sigma


@kernel
def _splat(points, sigma, chosen, camera, sigmas, max_reach, offsets, copies):
    eye, axis = camera
    for k in range(chosen.size):
        i = chosen[k]
        x, y, z = points[i, 0] - eye[0], points[i, 1] - eye[1], points[i, 2] - eye[2]
        per_depth = min(sigmas * sigma[i], max_reach) / (x * axis[0] + y * axis[1] + z * axis[2])
        for n in range(offsets.size):
            stretch = offsets[n] * per_depth
            copy = copies[k * offsets.size + n]
            copy[0], copy[1] = points[i, 0] + stretch * x, points[i, 1] + stretch * y
            copy[2] = points[i, 2] + stretch * z


def splat_along_ray_reference(
    points: Array, sigma: Array, sensor: Transform, sigmas: float, min_reach: float, max_reach: float
) -> tuple[Array, Array]:
    """The same as `splat_along_ray`, in plain numpy."""
    far = sigma * np.float32(sigmas) >= np.float32(min_reach)
    points, sigma = points[far], sigma[far]
    ray = points - sensor.translation
    stretch = (np.minimum(sigmas * sigma, max_reach) / (ray @ sensor.rotation[:, 2]))[:, None] * OFFSETS
    copies = points[:, None] + stretch[:, :, None] * ray[:, None]
    return copies.reshape(-1, 3).astype(np.float32), sigma.repeat(len(OFFSETS))
