"""Propagation of a pose's covariance."""

from __future__ import annotations

import numpy as np

from stages.data.arrays import Array


def translated_covariance(covariance: Array, offset: Array) -> Array:
    """Covariance (6, 6) of position and rotation at a point `offset` (3,), m, from here: rotation errors move it."""
    lever = np.eye(6)
    lever[:3, 3:] = -cross_matrix(offset)
    return lever @ covariance @ lever.T


def cross_matrix(vector: Array) -> Array:
    """The matrix (3, 3) of the cross product with a vector (3,)."""
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
