"""What wheels and a gyro make of a drive: dead reckoning, whose place and heading stray with the way.

Each true step is counted too long by the same share and turned by the error that the heading has by then; that error
is a random walk along the way, so a rover that stands still does not stray.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from recordings.simulator.traverse import level_pose
from stages.data import Array, Pose, Transform

LEAST_PLACE, LEAST_TURN = 1e-3, 3e-3  # m and rad, standard deviations that even an exact odometry states


def dead_reckoning(
    stamps: Sequence[int], bases: Sequence[Transform], ways: Array, scale: float, turn: float, rng: np.random.Generator
) -> list[Pose]:
    """Odometry `odom` <- base_link at n stamps, ns; `odom` is the frame `level` of the first.

    bases: the true world <- base_link; ways: (n,) m driven until then; scale: share by which lengths are overstated;
    turn: rad, standard deviation of the heading's error after 1 m, which grows with the root of the way. With 0 and 0
    it is exact.
    """
    odom = level_pose(bases[0]).inverse()
    steps = np.abs(np.diff(ways))
    strayed = np.concatenate([[0.0], np.cumsum(rng.normal(0.0, 1.0, len(steps)) * turn * np.sqrt(steps))])
    true = odom(np.array([base.translation for base in bases]))
    halfway = Rotation.from_rotvec(np.outer((strayed[1:] + strayed[:-1]) / 2, [0, 0, 1]))
    moved = halfway.apply(np.diff(true, axis=0)) * (1 + scale) if len(steps) else np.zeros((0, 3))
    places = true[0] + np.concatenate([np.zeros((1, 3)), np.cumsum(moved, axis=0)])
    attitudes = Rotation.from_rotvec(np.outer(strayed, [0, 0, 1])) * Rotation.from_matrix(
        np.array([odom.rotation @ base.rotation for base in bases])
    )
    driven = np.concatenate([[0.0], np.cumsum(steps)])
    return [
        Pose(stamp, place, attitude, "odom", "base_link", _covariance(way, scale, turn))
        for stamp, place, attitude, way in zip(stamps, places, attitudes.as_quat(canonical=True), driven, strict=True)
    ]


def _covariance(way: float, scale: float, turn: float) -> Array:
    """(6, 6) of position, m, and turn, rad, after so many metres: what the two errors come to on a straight way."""
    place = (scale * way) ** 2 + turn**2 * way**3 / 3 + LEAST_PLACE**2
    heading = turn**2 * way + LEAST_TURN**2
    return np.diag([place, place, place, LEAST_TURN**2, LEAST_TURN**2, heading])
