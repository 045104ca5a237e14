"""Simulated odometry of wheels and a gyro: dead reckoning, whose position and heading drift with the distance.

Each true step is lengthened by the scale error and rotated by the heading error so far. The heading error is a random
walk over the distance, so a rover that stands still does not drift.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from recordings.simulator.traverse import level_pose
from stages.data import Array, Pose, Transform

# In the covariance of an exact odometry, m and rad. Roll and pitch never have an error.
MIN_POSITION_SIGMA, MIN_HEADING_SIGMA, ATTITUDE_SIGMA = 1e-3, 3e-3, 5e-4


def dead_reckoning(
    stamps: Sequence[int],
    bases: Sequence[Transform],
    distances: Array,
    scale: float,
    turn: float,
    rng: np.random.Generator,
) -> list[Pose]:
    """Odometry `odom` <- base_link at n stamps, ns; `odom` is the frame `level` of the first.

    bases: the true world <- base_link; distances: (n,) m driven until then; scale: share by which they are overstated;
    turn: rad, standard deviation of the heading's error after 1 m, which grows with the square root of the distance.
    With 0 and 0 it is exact.
    """
    odom = level_pose(bases[0]).inverse()
    steps = np.abs(np.diff(distances))
    heading_error = np.concatenate([[0.0], np.cumsum(rng.normal(0.0, 1.0, len(steps)) * turn * np.sqrt(steps))])
    true = odom(np.array([base.translation for base in bases]))
    halfway = Rotation.from_rotvec(np.outer((heading_error[1:] + heading_error[:-1]) / 2, [0, 0, 1]))
    moved = halfway.apply(np.diff(true, axis=0)) * (1 + scale) if len(steps) else np.zeros((0, 3))
    places = true[0] + np.concatenate([np.zeros((1, 3)), np.cumsum(moved, axis=0)])
    attitudes = Rotation.from_rotvec(np.outer(heading_error, [0, 0, 1])) * Rotation.from_matrix(
        np.array([odom.rotation @ base.rotation for base in bases])
    )
    driven = np.concatenate([[0.0], np.cumsum(steps)])
    return [
        Pose(stamp, place, attitude, "odom", "base_link", _covariance(distance, scale, turn))
        for stamp, place, attitude, distance in zip(
            stamps, places, attitudes.as_quat(canonical=True), driven, strict=True
        )
    ]


def _covariance(distance: float, scale: float, turn: float) -> Array:
    """(6, 6) of position, m, and rotation, rad, after a straight drive of `distance`, m."""
    place = (scale * distance) ** 2 + turn**2 * distance**3 / 3 + MIN_POSITION_SIGMA**2
    heading = turn**2 * distance + MIN_HEADING_SIGMA**2
    return np.diag([place, place, place, ATTITUDE_SIGMA**2, ATTITUDE_SIGMA**2, heading])
