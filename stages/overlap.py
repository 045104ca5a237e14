"""What a frame has to rise and tilt to lie on a map that it overlaps: a robust plane through the height differences.

Errors of neighbouring cells are alike, so a patch of them counts as one; and cells that changed, or that stand at the
edge of a rock, lie far off and must not pull, so the fit is Huber's, by reweighting.
"""

from __future__ import annotations

import numpy as np

from stages.data import Array

PATCH = 0.3  # m, within which errors of stereo heights are alike
_HUBER = 1.345  # standard deviations; 95 % as efficient as least squares where all errors are normal
_ROUNDS = 12


def fit_plane(x: Array, y: Array, off: Array, variance: Array, expected: Array, resolution: float) -> Array:
    """The most likely plane (3,): height at (0, 0), m, and slopes along x and y.

    x, y: (n,) where, m; off: (n,) height differences, m; variance: (n,) of each, m^2; expected: (3,) standard
    deviations that the plane's numbers are known to have before anything is seen; resolution: cell size, m. Without
    cells the plane is zero.
    """
    known = np.flatnonzero(expected > 0)
    plane = np.zeros(3)
    design = np.stack([np.ones_like(x), x, y])[known]
    trust = 1 / (variance * max(1.0, (PATCH / resolution) ** 2))
    prior = np.diag(1 / expected[known] ** 2)
    spread = np.sqrt(variance)
    for _ in range(_ROUNDS if len(x) else 0):
        residual = np.abs(off - plane[known] @ design)
        weight = trust * np.minimum(1.0, _HUBER * spread / np.maximum(residual, 1e-12))
        weighted = design * weight
        plane[known] = np.linalg.solve(weighted @ design.T + prior, weighted @ off)
    return plane
