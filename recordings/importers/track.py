"""The poses of a body over time, as data sets give them, in a world whose z axis points up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from recordings.errors import LogError
from stages.data import Array, Transform

WORLD = "world"
MAX_GAP_NS = 1_000_000_000  # between two poses, to interpolate between them
EARTH_RADIUS = 6_378_137.0  # m


@dataclass(frozen=True, eq=False)
class Track:
    """n poses of the frame `body`, in the order of increasing stamps.

    stamps: (n,) int64 ns; positions: (n, 3) m; rotations: n, from the body to the world.
    """

    body: str
    stamps: Array
    positions: Array
    rotations: Rotation

    @staticmethod
    def of(body: str, poses: Sequence[tuple[int, Array, Rotation]], where: object) -> Track:
        """The track of (stamp, position, rotation) in any order. Raises LogError for an invalid position."""
        if not poses:
            raise LogError(f"{where} contains no pose; download it again")
        ordered = sorted({stamp: (place, turn) for stamp, place, turn in poses}.items())
        places = np.array([place for _, (place, _) in ordered])
        if (wrong := np.flatnonzero(~np.isfinite(places).all(axis=1))).size:
            raise LogError(f"{where}: the position at {ordered[wrong[0]][0]} ns is {places[wrong[0]].tolist()}")
        turns = Rotation.concatenate([turn for _, (_, turn) in ordered])
        return Track(body, np.array([stamp for stamp, _ in ordered]), places, turns)

    def at(self, stamp: int) -> Transform | None:
        """world <- body at a stamp, interpolated between two poses at most a second apart; else None."""
        after = int(np.searchsorted(self.stamps, stamp))
        if after < len(self.stamps) and self.stamps[after] == stamp:
            return self._transform(self.positions[after], self.rotations[after])
        if not 0 < after < len(self.stamps) or self.stamps[after] - self.stamps[after - 1] > MAX_GAP_NS:
            return None
        begin, end = int(self.stamps[after - 1]), int(self.stamps[after])
        share = (stamp - begin) / (end - begin)
        position = self.positions[after - 1] * (1 - share) + self.positions[after] * share
        return self._transform(position, Slerp([0.0, 1.0], self.rotations[after - 1 : after + 1])(share))

    def _transform(self, position: Array, rotation: Rotation) -> Transform:
        return Transform(WORLD, self.body, rotation.as_matrix(), position)


def mercator(latitude: Array, longitude: Array) -> Array:
    """(n, 2) m east and north of the first of n places, deg, as KITTI's development kit maps them."""
    scale = np.cos(np.radians(latitude[0]))
    east = scale * EARTH_RADIUS * np.radians(longitude)
    with np.errstate(invalid="ignore"):  # the track names a latitude beyond the poles
        north = scale * EARTH_RADIUS * np.log(np.tan(np.radians(90 + latitude) / 2))
    return np.column_stack([east - east[0], north - north[0]])


def upright(up: Array) -> Array:
    """A quaternion xyzw that turns the direction `up` (3,) of a sensor into z, by the shortest way."""
    direction = np.asarray(up, np.float64) / np.linalg.norm(up)
    axis, cosine = np.cross(direction, [0.0, 0.0, 1.0]), direction[2]
    if cosine < -1 + 1e-12:
        return np.array([1.0, 0.0, 0.0, 0.0])
    whole: Array = np.array([*axis, 1 + cosine])
    return np.asarray(whole / np.linalg.norm(whole))
