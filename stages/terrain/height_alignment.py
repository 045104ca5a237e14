"""What a frame has to rise and tilt to lie on a map that it overlaps: a robust plane through the height differences.

Errors of neighbouring cells are alike, so a patch of them counts as one; and cells that changed, or that stand at the
edge of a rock, lie far off and must not pull. The fit is by reweighting: Huber's weights first, which lead to the one
solution there is, then Cauchy's, with which what is far off pulls the less the farther it is.
"""

from __future__ import annotations

import numpy as np

from stages.data import Array

PATCH = 0.3  # m, within which errors of stereo heights are alike
# Standard deviations; 95 % as efficient as least squares where all errors are normal
_HUBER, _CAUCHY = 1.345, 2.385
_ROUNDS = 8  # of each


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
    for number in range(2 * _ROUNDS if len(x) else 0):
        residual = np.abs(off - plane[known] @ design) / spread
        if number < _ROUNDS:
            weight = np.minimum(1.0, _HUBER / np.maximum(residual, 1e-12))
        else:
            weight = 1 / (1 + (residual / _CAUCHY) ** 2)
        weighted = design * (weight * trust)
        plane[known] = np.linalg.solve(weighted @ design.T + prior, weighted @ off)
    return plane


def rise(plane: Array, x: Array, y: Array) -> Array:
    """The height, m, of a plane of `fit_plane` at the places (x, y), (n,) m each: (n,)."""
    return np.asarray(plane @ [np.ones_like(x), x, y])
