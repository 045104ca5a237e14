"""Elevations that are certainly lit: per ground cell the height above which the terrain casts no shadow.

Terrain and sun do not move, so most shadow rays are decided once for all images. The cells are swept once against the
light, along lines parallel to it (as Timonen and Westerholm 2010 sweep for horizons). Every rounding is upwards: points
above the bound need no ray, and only the others are left to the ray caster.
"""

from __future__ import annotations

from math import ceil, floor

import numpy as np

from recordings.simulator.raycast import BUCKET_LEVEL, Scene
from stages.data import Array

# Within so many cells ground shades ground only if it is steeper than the light; beyond, its tops decide.
NEAR_CELLS = 3


def lit_above(scn: Scene, sun: Array) -> Array:
    """(n, n) float32 elevations, m: no ray towards `sun` (3,) from a point of the cell above them hits anything.

    The points must be on the ground or above it. inf: unknown.
    """
    tops, near = scn.tops[: scn.ground.size].reshape(scn.ground.shape), _near(scn, sun)
    along, across = float(sun[0]), float(sun[1])
    swapped = abs(across) > abs(along)
    if swapped:
        along, across, tops, near = across, along, tops.T, near.T
    turn = slice(None, None, 1 if along >= 0 else -1)
    flat = max(abs(along), 1e-6)
    bound = _swept(tops.T[turn], near.T[turn], across / flat, float(sun[2]) / flat * scn.resolution)[turn].T
    return np.ascontiguousarray(bound.T if swapped else bound)


def _near(scn: Scene, sun: Array) -> Array:
    """(n, n) float32: elevation over which a cell does not shade rays that come from ground beside it.

    inf where the ground rises more steeply than the light; the tops of rocks; else -inf.
    """
    right = np.diff(scn.ground, axis=1, append=scn.ground[:, :1]) * np.float32(sun[0] / scn.resolution)
    up = np.diff(scn.ground, axis=0, append=scn.ground[:1]) * np.float32(sun[1] / scn.resolution)
    # A bilinear patch is nowhere steeper than the steeper of its opposite edges.
    rise = np.maximum(right, np.roll(right, -1, axis=0)) + np.maximum(up, np.roll(up, -1, axis=1))
    buckets, size = len(scn.ground) >> BUCKET_LEVEL, 1 << BUCKET_LEVEL
    rocky = (np.diff(scn.bucket_start) > 0).reshape(buckets, buckets).repeat(size, axis=0).repeat(size, axis=1)
    tops = scn.tops[: scn.ground.size].reshape(scn.ground.shape)
    near = np.where(rocky, tops, np.float32(-np.inf))
    near[rise >= np.float32(sun[2] * (1 - 1e-4))] = np.inf
    return near


def _swept(tops: Array, near: Array, drift: float, rise: float) -> Array:
    """`lit_above` for light from the far end of the first axis of tops and near (n, n).

    From cell to cell along the first axis its rays move by `drift` cells, at most one, along the second and rise by
    `rise`, m. Line m of a step holds the rays with m <= place - drift * step < m + 1; they keep their line for ever.
    """
    n = len(tops)
    tops, near = (np.tile(_over_three(cells), 2) for cells in (tops, near))
    lift = np.float32(rise * (1 - 2e-5))  # float32 sums stay on the safe side
    reach = min(ceil(float(np.ptp(tops)) / rise) + 1, 8 * n)
    ahead = np.full(n, -np.inf, np.float32)
    horizon, beside = np.empty((2, n + NEAR_CELLS, n), np.float32)
    for step in range(n + NEAR_CELLS + reach, -1, -1):
        shift = floor(min(drift * step, drift * (step + 1))) % n
        ahead = np.maximum(tops[step % n, shift : shift + n], ahead - lift)
        if step < n + NEAR_CELLS:
            horizon[step], beside[step] = ahead, near[step % n, shift : shift + n]
    bound = np.maximum(horizon[NEAR_CELLS:] - (NEAR_CELLS - 1) * lift, beside[:n])
    for k in range(1, NEAR_CELLS):
        np.maximum(bound, beside[k : k + n] - (k - 1) * lift, out=bound)
    for step in range(n):
        bound[step] = np.roll(bound[step], -floor(-max(drift * step, drift * (step + 1))))
    return _over_three(bound)


def _over_three(rows: Array) -> Array:
    """The largest of each entry of (n, n) and the two that follow it along the second axis, without end."""
    following = np.concatenate([rows, rows[:, :2]], axis=1)
    return np.asarray(np.maximum(np.maximum(following[:, :-2], following[:, 1:-1]), following[:, 2:]))
