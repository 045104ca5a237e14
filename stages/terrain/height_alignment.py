"""The plane that aligns a frame to the map it overlaps: a robust fit through the height differences.

Errors of neighbouring cells are alike, so a patch of them counts as one. Cells that changed, or lie at the edge of a
rock, are outliers. The fit is iteratively reweighted: Huber's weights first, which have a single solution, then
Cauchy's, whose influence falls with the distance.
"""

from __future__ import annotations

import numpy as np

from stages.data import Array

CORRELATION_LENGTH = 0.3  # m, of stereo height errors
_HUBER, _CAUCHY = 1.345, 2.385  # standard deviations; 95 % as efficient as least squares for normal errors
_ROUNDS = 8  # of each
MAX_CELLS = 4000  # in a fit; the errors of neighbours are alike, so more of them add little


def fit_plane(
    x: Array, y: Array, off: Array, variance: Array, expected: Array, resolution: float
) -> tuple[Array, Array]:
    """The most likely plane (3,): height at (0, 0), m, and slopes along x and y; and its covariance (3, 3).

    Without cells the plane is zero, and its covariance is the prior's.

    x, y: (n,) positions, m; off: (n,) height differences, m; variance: (n,) of each, m^2; expected: (3,) prior standard
    deviations of the plane's numbers; resolution: cell size, m.
    """
    step = -(-len(x) // MAX_CELLS) or 1
    x, y, off, variance = x[::step], y[::step], off[::step], variance[::step]
    known = np.flatnonzero(expected > 0)
    plane, covariance = np.zeros(3), np.zeros((3, 3))
    design = np.stack([np.ones_like(x), x, y])[known]
    trust = 1 / (variance * max(1.0, (CORRELATION_LENGTH / resolution) ** 2 / step))
    normal = prior = np.diag(1 / expected[known] ** 2)
    sigma = np.sqrt(variance)
    for number in range(2 * _ROUNDS if len(x) else 0):
        residual = np.abs(off - plane[known] @ design) / sigma
        if number < _ROUNDS:
            weight = np.minimum(1.0, _HUBER / np.maximum(residual, 1e-12))
        else:
            weight = 1 / (1 + (residual / _CAUCHY) ** 2)
        weighted = design * (weight * trust)
        normal = weighted @ design.T + prior
        plane[known] = np.linalg.solve(normal, weighted @ off)
    covariance[np.ix_(known, known)] = np.linalg.inv(normal)
    return plane, covariance


def plane_height(plane: Array, x: Array, y: Array) -> Array:
    """The height, m, of a plane of `fit_plane` at (x, y), (n,) m each: (n,)."""
    return np.asarray(plane @ [np.ones_like(x), x, y])
