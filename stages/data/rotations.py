"""Rotations as matrices, quaternions (x, y, z, w) and rotation vectors, by the formulas of scipy's `Rotation`.

To import that takes a third of the time in which a command starts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from stages.data.arrays import Array

_ORTHONORMAL = np.eye(3) * 1e-5 + 1e-12  # largest deviations of the products of a matrix's rows from 1 and 0
_SMALL_ANGLE = 1e-3  # rad, below which a series is used


def matrix_of(quaternion: Sequence[float] | Array) -> Array:
    """The matrix (3, 3) of a quaternion of any length but 0."""
    return _matrix(*unit(quaternion).tolist())


def unit(quaternion: Sequence[float] | Array) -> Array:
    """The quaternion (4,) of length 1 of the same rotation."""
    return np.array(_unit([float(value) for value in quaternion]))


def _matrix(x: float, y: float, z: float, w: float) -> Array:
    return np.array(
        [
            [x * x - y * y - z * z + w * w, 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), -(x * x) + y * y - z * z + w * w, 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), -(x * x) - y * y + z * z + w * w],
        ]
    )


def quaternion_of(matrix: Array) -> Array:
    """The quaternion (4,) of length 1 of the rotation nearest to a matrix (3, 3), which must not mirror."""
    if not np.linalg.det(matrix) > 0:
        raise ValueError(f"the matrix {matrix.tolist()} is no rotation: its determinant is not positive")
    if not np.all(np.abs(matrix @ matrix.T - np.eye(3)) <= _ORTHONORMAL):
        left, _, right = np.linalg.svd(matrix)
        matrix = left @ right
    m = matrix.tolist()
    trace = m[0][0] + m[1][1] + m[2][2]
    largest = int(np.argmax([m[0][0], m[1][1], m[2][2], trace]))
    if largest == 3:
        return np.array(_unit([m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1], 1 + trace]))
    i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
    found = [0.0, 0.0, 0.0, m[k][j] - m[j][k]]
    found[i], found[j], found[k] = 1 - trace + 2 * m[i][i], m[j][i] + m[i][j], m[k][i] + m[i][k]
    return np.array(_unit(found))


def nearest_rotation(matrix: Array) -> Array:
    """The rotation (3, 3) nearest to a matrix (3, 3), which must not mirror."""
    return _matrix(*quaternion_of(matrix).tolist())


def canonical(quaternion: Array) -> Array:
    """The one of the two equal quaternions whose w is positive; if it is 0, whose first element but 0 is."""
    first = next((value for value in quaternion[[3, 0, 1, 2]] if value != 0), 1.0)
    return -quaternion if first < 0 else quaternion


def product(first: Array, second: Array) -> Array:
    """The quaternion (4,) of the rotation `second`, followed by `first`; both of length 1."""
    (a, b, c, d), (x, y, z, w) = first.tolist(), second.tolist()
    return np.array(
        _unit(
            [
                d * x + w * a + (b * z - c * y),
                d * y + w * b + (c * x - a * z),
                d * z + w * c + (a * y - b * x),
                d * w - a * x - b * y - c * z,
            ]
        )
    )


def turn_by(vector: Sequence[float] | Array) -> Array:
    """The matrix (3, 3) of a rotation vector, rad."""
    x, y, z = (float(value) for value in vector)
    angle = math.sqrt(x * x + y * y + z * z)
    if angle <= _SMALL_ANGLE:
        square = angle * angle
        scale = 0.5 - square / 48 + square * square / 3840
    else:
        scale = math.sin(angle / 2) / angle
    return _matrix(scale * x, scale * y, scale * z, math.cos(angle / 2))


def turn_about_z(angle: float) -> Array:
    """The matrix (3, 3) of a turn about z, rad."""
    return _matrix(0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2))


def angle_of(matrix: Array) -> float:
    """The angle of the rotation nearest to a matrix (3, 3), rad."""
    x, y, z, w = quaternion_of(matrix).tolist()
    return 2 * math.atan2(math.sqrt(x * x + y * y + z * z), abs(w))


def _unit(quaternion: list[float]) -> list[float]:
    x, y, z, w = quaternion
    length = math.sqrt(x * x + y * y + z * z + w * w)
    return [value / length for value in quaternion]
