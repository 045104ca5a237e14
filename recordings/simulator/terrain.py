"""The ground of the simulator: rolling fractal relief strewn with rocks of the Golombek size-frequency law.

Relief is fractional Brownian motion (H = 0.7) from an inverse FFT, so the tile repeats without a seam. Rocks follow
F_k(D) = k exp(-q D), q = 1.79 + 0.152/k (Golombek et al. 2003). They are partly buried ellipsoids cut by planes: they
look like broken stone, and rays hit them in closed form, so edges and truth are exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft

from recordings.simulator.raycast import BUCKET_LEVEL, Scene, heights_at, scene
from stages.data import Array

HURST = 0.7
MIN_WAVELENGTH = 0.35  # m of the relief; smaller gravel is in the texture
SHAPES = 32
FACETS = 12
DIAMETERS = 4000  # at which the size-frequency law is integrated
BOUND_STEPS = 150  # of the descent to the bounds of the rocks' tops


def decay(abundance: float) -> float:
    """q of the size-frequency law, 1/m."""
    return 1.79 + 0.152 / abundance


def rocks_per_area(abundance: float, smallest: float, largest: float) -> tuple[Array, Array]:
    """Diameters (DIAMETERS,), m, and the number of rocks per m^2 from `smallest` up to each of them.

    The density that goes with F_k is n(D) = k q exp(-q D) / (pi D^2 / 4); it is integrated by the trapezoid rule.
    """
    diameter = np.geomspace(smallest, largest, DIAMETERS)
    density = abundance * decay(abundance) * np.exp(-decay(abundance) * diameter) / (np.pi / 4 * diameter**2)
    number = np.concatenate([[0.0], np.cumsum(np.diff(diameter) * (density[1:] + density[:-1]) / 2)])
    return diameter, number


@dataclass(frozen=True, eq=False)
class Rocks:
    """Rocks of one tile; every array has one entry a rock.

    center: (N, 2) m, in the tile; diameter: m, mean horizontal; height: m, of the top above the ground at `center`;
    base: m, that ground; semi_axes: (N, 3) m; yaw: rad; middle: m, elevation of the ellipsoid's centre; shape: index of
    the set of cutting planes.
    """

    center: Array
    diameter: Array
    height: Array
    base: Array
    semi_axes: Array
    yaw: Array
    middle: Array
    shape: Array

    def __len__(self) -> int:
        return len(self.diameter)

    def only(self, kept: Array) -> Rocks:
        """The rocks that the mask `kept` (N,) selects."""
        return Rocks(**{name: getattr(self, name)[kept] for name in self.__dataclass_fields__})


@dataclass(frozen=True, eq=False)
class Terrain:
    """Ground and rocks, repeating every `extent` metres along x and y.

    ground: (n, n) float32 elevations, m, of the nodes at y = row * resolution, x = column * resolution, bilinear
    between them; n a power of two.
    """

    ground: Array
    resolution: float
    rocks: Rocks
    facets: Array

    @cached_property
    def scene(self) -> Scene:
        """Ground and rocks for the ray caster."""
        return _scene(self.ground, self.resolution, self.rocks, self.facets)

    @property
    def extent(self) -> float:
        """Period of the tile, m."""
        return len(self.ground) * self.resolution

    def elevation(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Ground elevation, m, without rocks; any shape."""
        return elevation(self.ground, self.resolution, x, y)

    def slope(self, x: ArrayLike, y: ArrayLike, span: float = 0.3) -> Array:
        """Slope of the ground, rad, over `span` metres, without rocks; any shape."""
        x, y, half = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64), span / 2
        along = self.elevation(x + half, y) - self.elevation(x - half, y)
        across = self.elevation(x, y + half) - self.elevation(x, y - half)
        return np.asarray(np.arctan(np.hypot(along, across) / span))

    def cleared(self, path: Array, half_width: float, height: float) -> Terrain:
        """This terrain without the rocks of at least `height` within `half_width` of the points `path` (N, 2)."""
        rocks, extent = self.rocks, self.extent
        high = np.flatnonzero(rocks.height >= height)
        nearest = np.full(len(high), np.inf)
        for point in path:
            offset = (rocks.center[high] - point + extent / 2) % extent - extent / 2
            np.minimum(nearest, np.hypot(offset[:, 0], offset[:, 1]), out=nearest)
        kept = np.ones(len(rocks), bool)
        kept[high[nearest < half_width + rocks.semi_axes[high, :2].max(axis=1)]] = False
        return Terrain(self.ground, self.resolution, rocks.only(kept), self.facets)


def elevation(ground: Array, resolution: float, x: ArrayLike, y: ArrayLike) -> Array:
    """Bilinear elevation of the repeating tile `ground` at points (x, y) of any shape, m."""
    x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
    return np.asarray(heights_at(ground, resolution, x.ravel(), y.ravel()).reshape(x.shape))


def make_terrain(
    rng: np.random.Generator,
    cells: int,
    resolution: float,
    slope: float,
    abundance: float,
    smallest: float,
    largest: float,
) -> Terrain:
    """A tile of `cells` x `cells` (a power of two).

    slope: rad, RMS over a baseline of 1 m; abundance: the k of Golombek's law, 0 for bare ground; smallest, largest:
    diameters of rocks, m.
    """
    ground = relief(rng, cells, resolution, slope)
    facets, extents = _shapes(rng)
    rocks = _strew(rng, ground, resolution, abundance, smallest, largest, extents)
    return Terrain(ground, resolution, rocks, facets)


def relief(rng: np.random.Generator, cells: int, resolution: float, slope: float) -> Array:
    """Fractional Brownian elevations, (cells, cells) float32, whose RMS slope over 1 m is `slope`, rad."""
    noise = rng.standard_normal((cells, cells)).astype(np.float32)
    y, x = np.fft.fftfreq(cells, resolution)[:, None], np.fft.rfftfreq(cells, resolution)[None, :]
    square = (y**2 + x**2).astype(np.float32)
    square[0, 0] = np.inf
    amplitude = square ** np.float32(-(HURST + 1) / 2) * np.exp(-((square * np.float32(MIN_WAVELENGTH**2)) ** 2))
    shape = fft.irfft2(fft.rfft2(noise) * amplitude, (cells, cells))
    metre = max(1, round(1.0 / resolution))
    rises = [np.roll(shape, metre, axis=axis) - shape for axis in (0, 1)]
    rms = float(np.sqrt(np.mean(np.square(rises)))) / (metre * resolution)
    return np.asarray(shape * np.float32(np.tan(slope) / rms))


def _shapes(rng: np.random.Generator) -> tuple[Array, Array]:
    """Sets of planes n . p <= d that cut the unit sphere, (SHAPES, FACETS, 4), and the size of the rest, (SHAPES, 2):
    mean horizontal diameter and height of the top above the centre."""
    normals = rng.standard_normal((SHAPES, FACETS, 3))
    normals[..., 2] = np.abs(normals[..., 2]) * 0.8
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    facets = np.concatenate([normals, rng.uniform(0.58, 0.9, (SHAPES, FACETS, 1))], axis=-1)
    directions = rng.standard_normal((3000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    with np.errstate(divide="ignore"):
        reach = facets[..., 3, None] / np.maximum(facets[..., :3] @ directions.T, 0)
    points = np.minimum(1, reach.min(axis=1))[..., None] * directions
    azimuth = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    support = points[..., :2] @ np.stack([np.cos(azimuth), np.sin(azimuth)])
    return facets, np.stack([2 * support.max(axis=1).mean(axis=-1), points[..., 2].max(axis=1)], axis=-1)


def _strew(
    rng: np.random.Generator,
    ground: Array,
    resolution: float,
    abundance: float,
    smallest: float,
    largest: float,
    extents: Array,
) -> Rocks:
    """Rocks placed at random (Poisson) on a tile, their sizes by the size-frequency law."""
    extent = len(ground) * resolution
    count, size = 0, np.zeros(0)
    if abundance > 0:
        diameters, number = rocks_per_area(abundance, smallest, largest)
        count = int(rng.poisson(number[-1] * extent**2))
        size = np.interp(rng.uniform(0, number[-1], count), number, diameters)
    center = rng.uniform(0, extent, (count, 2))
    height = size * rng.uniform(0.3, 0.6, count)
    shape = rng.integers(0, SHAPES, count)
    aspect = np.sqrt(rng.uniform(0.65, 1.0, count))
    lift = rng.uniform(0.0, 0.35, count)
    width = size / extents[shape, 0]
    vertical = height / (extents[shape, 1] + lift)
    base = elevation(ground, resolution, center[:, 0], center[:, 1])
    semi_axes = np.stack([width / aspect, width * aspect, vertical], axis=1)
    return Rocks(center, size, height, base, semi_axes, rng.uniform(0, 2 * np.pi, count), base + lift * vertical, shape)


def _scene(ground: Array, resolution: float, rocks: Rocks, facets: Array) -> Scene:
    """Max pyramid of ground and rocks, and the list of the rocks that touch each bucket of ground."""
    patch = np.maximum(ground, np.roll(ground, -1, axis=0))
    patch = np.maximum(patch, np.roll(patch, -1, axis=1))
    buckets = len(ground) >> BUCKET_LEVEL
    bucket, rock, top = _touched(rocks, _tops(facets)[rocks.shape], buckets, resolution * (1 << BUCKET_LEVEL))
    order = np.argsort(bucket, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(bucket, minlength=buckets**2))]).astype(np.int32)
    tops = np.full(buckets**2, -np.inf, np.float32)
    np.maximum.at(tops, bucket, top.astype(np.float32) + np.float32(1e-4))
    solid = np.column_stack([
        rocks.center % (len(ground) * resolution), rocks.middle, 1 / rocks.semi_axes, np.cos(rocks.yaw),
        np.sin(rocks.yaw),
    ])  # fmt: skip
    return scene(
        ground, resolution, patch, tops.reshape(buckets, buckets), solid, rocks.shape.astype(np.int32), facets,
        start, rock[order].astype(np.int32),
    )  # fmt: skip


def _tops(facets: Array) -> Array:
    """Close upper bounds of the heights of the cut spheres `facets` (S, F, 4): (S,).

    With weights w >= 0 of the planes n . p <= d, every point has z <= w . d + |up - sum w n|; the weights
    descend to its minimum.
    """
    normals, distance = facets[..., :3], facets[..., 3]
    weights, least = np.zeros(distance.shape), np.ones(len(facets))
    for step in range(BOUND_STEPS):
        rest = np.array([0.0, 0.0, 1.0]) - np.einsum("sf,sfk->sk", weights, normals)
        length = np.linalg.norm(rest, axis=1)
        np.minimum(least, np.einsum("sf,sf->s", weights, distance) + length, out=least)
        ahead = np.einsum("sfk,sk->sf", normals, rest / np.maximum(length, 1e-9)[:, None]) - distance
        weights = np.maximum(weights + 0.3 / np.sqrt(step + 1) * ahead, 0.0)
    return least


def _touched(rocks: Rocks, reach_up: Array, buckets: int, size: float) -> tuple[Array, Array, Array]:
    """For every bucket that a rock touches: bucket index, rock index and an upper bound of the rock's elevation there.

    reach_up: (N,) bounds of the rocks' tops above their middles, as shares of the semi-axis.
    """
    longest, c, s = rocks.semi_axes[:, :2].max(axis=1, initial=0.0), np.cos(rocks.yaw), np.sin(rocks.yaw)
    reach = np.hypot(np.stack([c, s]) * rocks.semi_axes[:, 0], np.stack([s, c]) * rocks.semi_axes[:, 1]).T
    low = np.floor((rocks.center - reach) / size).astype(np.int32)
    span = np.floor((rocks.center + reach) / size).astype(np.int32) - low + 1
    count = span.prod(axis=1)
    rock = np.repeat(np.arange(len(rocks), dtype=np.int32), count)
    nth = np.arange(len(rock), dtype=np.int32) - np.repeat((np.cumsum(count) - count).astype(np.int32), count)
    place = low[rock] + np.column_stack([nth % span[rock, 0], nth // span[rock, 0]])
    # Away from its middle an ellipsoid is at most as high as the sphere of its longest axis, squeezed to its height.
    gap = np.abs((place + 0.5) * size - rocks.center[rock]) - size / 2
    away = np.square(np.maximum(gap, 0.0)).sum(axis=1) / longest[rock] ** 2
    top = rocks.middle[rock] + rocks.semi_axes[rock, 2] * np.minimum(np.sqrt(np.maximum(1 - away, 0.0)), reach_up[rock])
    place %= buckets
    met = away < 1
    return (place[:, 1] * buckets + place[:, 0])[met], rock[met], top[met]
