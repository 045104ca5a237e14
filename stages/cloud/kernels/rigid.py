"""A rigid transform of many points, in one pass, in float64.

A BLAS matrix product is not used, because its last bits depend on the number of threads.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array


def transform_points(points: Array, rotation: Array, translation: Array) -> Array:
    """`rotation @ p + translation` of every point (N, 3) float32, as (N, 3) float32."""
    return _transform_points(  # type: ignore[no-any-return]
        np.ascontiguousarray(points),
        np.ascontiguousarray(rotation, dtype=np.float64),
        np.ascontiguousarray(translation, dtype=np.float64),
    )


@kernel
def _transform_points(points, r, t):
    moved = np.empty(points.shape, np.float32)
    for i in range(points.shape[0]):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        moved[i, 0] = r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + t[0]
        moved[i, 1] = r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + t[1]
        moved[i, 2] = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + t[2]
    return moved


def transform_points_reference(points: Array, rotation: Array, translation: Array) -> Array:
    """The same as `transform_points`, in plain numpy."""
    return (points.astype(np.float64) @ rotation.T + translation).astype(np.float32)
