"""Points laid along their lines of sight, as far as their depth is unsure.

Far from the camera a pixel's depth is known to no better than a cell or more: which of the cells along its line of
sight gets the point is luck. Laid at a few places to both sides of itself, it reaches all of them.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array, Transform

PLACES = np.array([-1.0, -0.5, 0.5, 1.0])  # of the reach


def laid_along_sight(
    points: Array, sigma: Array, sensor: Transform, reach: float, least: float, most: float
) -> tuple[Array, Array]:
    """Copies of the points that reach at least so far, to both sides of each.

    points: (N, 3) float32, m; sigma: (N,) float32, depth standard deviation, m; sensor: the camera in the points'
    frame; reach: standard deviations of depth; least, most: m of depth, points with a shorter reach are left out, a
    longer one is cut. Returns the copies, (4 M, 3) float32, and their sigma, (4 M,) float32.
    """
    chosen = np.flatnonzero(sigma * np.float32(reach) >= np.float32(least))
    copies, their_sigma = np.empty((len(PLACES) * len(chosen), 3), np.float32), sigma[chosen].repeat(len(PLACES))
    _lay(points, sigma, chosen, sensor.translation, sensor.rotation[:, 2].copy(), reach, most, PLACES, copies)
    return copies, their_sigma


@kernel
def _lay(points, sigma, chosen, eye, axis, reach, most, places, copies):
    for k in range(chosen.size):
        i = chosen[k]
        x, y, z = points[i, 0] - eye[0], points[i, 1] - eye[1], points[i, 2] - eye[2]
        per_depth = min(reach * sigma[i], most) / (x * axis[0] + y * axis[1] + z * axis[2])
        for place in range(places.size):
            stretch = places[place] * per_depth
            copy = copies[k * places.size + place]
            copy[0], copy[1] = points[i, 0] + stretch * x, points[i, 1] + stretch * y
            copy[2] = points[i, 2] + stretch * z


def laid_along_sight_reference(
    points: Array, sigma: Array, sensor: Transform, reach: float, least: float, most: float
) -> tuple[Array, Array]:
    """`laid_along_sight`, in plain numpy."""
    far = sigma * np.float32(reach) >= np.float32(least)
    points, sigma = points[far], sigma[far]
    sight = points - sensor.translation
    stretch = (np.minimum(reach * sigma, most) / (sight @ sensor.rotation[:, 2]))[:, None] * PLACES
    copies = points[:, None] + stretch[:, :, None] * sight[:, None]
    return copies.reshape(-1, 3).astype(np.float32), sigma.repeat(len(PLACES))
