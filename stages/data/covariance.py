"""How the uncertainty of a place and a turn goes along a way."""

from __future__ import annotations

import numpy as np

from stages.data.arrays import Array


def levered(covariance: Array, way: Array) -> Array:
    """A covariance (6, 6) of position and turn, after a way (3,), m, whose direction the turn decides."""
    lever = np.eye(6)
    lever[:3, 3:] = -cross_matrix(way)
    return lever @ covariance @ lever.T


def cross_matrix(vector: Array) -> Array:
    """The matrix (3, 3) of the cross product with a vector (3,)."""
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
