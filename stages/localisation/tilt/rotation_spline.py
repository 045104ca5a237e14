"""A smooth rotation over time: the rotation vector from each sample to the next is a cubic of time.

Angular rate and acceleration are continuous. It is scipy's `RotationSpline`, whose import takes a quarter of a second.
The formulas are those of its "Smooth Attitude Interpolation".
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from stages.data import Array
from stages.data.rotations import rotation_vector

MAX_ROUNDS, TOLERANCE = 10, 1e-9  # of the angular rates
SMALL_ANGLE = 1e-4  # rad, below which a series is used


class RotationSpline:
    """Interpolates the rotations (n, 3, 3) at n increasing times, s; n is at least 3."""

    def __init__(self, times: Array, rotations: Array) -> None:
        self._times, self._rotations = times, rotations
        turns = np.array([rotation_vector(before.T @ after) for before, after in pairwise(rotations)])
        steps = np.diff(times)[:, None]
        begin, end = _rates(turns, steps)
        self._cubic = (steps * (begin + end) - 2 * turns) / steps**3
        self._square = (3 * turns - steps * (2 * begin + end)) / steps**2
        self._linear = begin

    def __call__(self, times: Array) -> Array:
        """The rotations (m, 3, 3) at m times, s."""
        at = np.clip(np.searchsorted(self._times, times, side="right") - 1, 0, len(self._times) - 2)
        since = (times - self._times[at])[:, None]
        vectors = ((self._cubic[at] * since + self._square[at]) * since + self._linear[at]) * since
        angle, small, cross = *_angles(vectors), _cross(vectors)
        sine = np.where(small, 1 - angle**2 / 6, np.sin(angle) / angle)
        versine = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(angle)) / angle**2)
        turns = np.eye(3) + sine[:, None, None] * cross + versine[:, None, None] * cross @ cross
        return np.asarray(self._rotations[at] @ turns)


def _rates(turns: Array, steps: Array) -> tuple[Array, Array]:
    """The derivatives (n, 3) of the rotation vectors of n steps, rad/s, at their begin and end.

    The rates at the ends of the whole are the mean ones of the first and the last step.
    """
    angle, small, cross = *_angles(turns), _cross(turns)
    k = np.where(small, 1 / 12 + angle**2 / 720, (1 - 0.5 * angle / np.tan(0.5 * angle)) / angle**2)
    to_vector = np.eye(3) + 0.5 * cross + k[:, None, None] * cross @ cross
    k = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(angle)) / angle**2)
    to_rate = np.eye(3) - k[:, None, None] * cross
    k = np.where(small, 1 / 6 - angle**2 / 120, (angle - np.sin(angle)) / angle**3)
    to_rate += k[:, None, None] * cross @ cross
    inner, rates = np.arange(len(turns) - 1), turns / steps
    first, last = rates[0], rates[-1]
    system = np.zeros((len(inner), 3, len(inner), 3))
    system[inner, :, inner] = (4 / steps[:-1] + 4 / steps[1:])[:, :, None] * np.eye(3)
    system[inner[1:], :, inner[:-1]] = 2 * to_rate[1:-1] / steps[1:-1, :, None]
    system[inner[:-1], :, inner[1:]] = 2 * to_vector[1:-1] / steps[1:-1, :, None]
    right = 6 * (turns[:-1] / steps[:-1] ** 2 + turns[1:] / steps[1:] ** 2)
    right[0] -= 2 / steps[0] * (to_rate[0] @ first)
    right[-1] -= 2 / steps[-1] * (to_vector[-1] @ last)
    for _ in range(MAX_ROUNDS):
        bent = right - _bend(turns[:-1], np.einsum("kij,kj->ki", to_vector[:-1], rates[:-1]))
        found = np.linalg.solve(system.reshape(bent.size, bent.size), bent.ravel()).reshape(-1, 3)
        settled = np.all(np.abs(found - rates[:-1]) < TOLERANCE * (1 + np.abs(found)))
        rates = np.vstack([found, last])
        if settled:
            break
    return np.vstack([first, rates[:-1]]), np.einsum("kij,kj->ki", to_vector, rates)


def _bend(vectors: Array, derivatives: Array) -> Array:
    """The part of the angular acceleration (n, 3) that is quadratic in the derivatives of the rotation vectors."""
    angle, small = _angles(vectors)
    sine, cosine = np.sin(angle), np.cos(angle)
    across = np.cross(vectors, derivatives)
    k1 = np.where(small, 1 / 12 - angle**2 / 180, (-angle * sine - 2 * (cosine - 1)) / angle**4)
    k2 = np.where(small, -1 / 60 + angle**2 / 1260, (3 * sine - 2 * angle - angle * cosine) / angle**5)
    k3 = np.where(small, 1 / 6 - angle**2 / 120, (angle - sine) / angle**3)
    along = np.sum(vectors * derivatives, axis=1)[:, None]
    turning = along * (k1[:, None] * across + k2[:, None] * np.cross(vectors, across))
    return np.asarray(turning + k3[:, None] * np.cross(derivatives, across))


def _angles(vectors: Array) -> tuple[Array, Array]:
    """The angles (n,) of rotation vectors, at least `SMALL_ANGLE`; and which of them are smaller, where series hold."""
    angle = np.linalg.norm(vectors, axis=1)
    return np.maximum(angle, SMALL_ANGLE), angle <= SMALL_ANGLE


def _cross(vectors: Array) -> Array:
    """The matrices (n, 3, 3) that multiply by vectors from the left as in a cross product."""
    return np.asarray(np.cross(vectors[:, None], np.eye(3)).swapaxes(1, 2))
