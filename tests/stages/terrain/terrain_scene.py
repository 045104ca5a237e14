"""Scenes with ground truth for the terrain tests: a plane with rocks in a camera's view, and terrain grids."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from stages.data import Array, Disparity, ElevationMap, StereoCamera, StereoFrame, Tilt
from tests.stages.builders import disparity_of

# The Devon Island camera at half size.
CAMERA = StereoCamera(484.5, 484.5, 317.3, 231.5, 0.24, 640, 480)
HEIGHT, PITCH = 1.0, np.deg2rad(15.0)
UP = np.array([0.0, -np.cos(PITCH), -np.sin(PITCH)])
TILT = Tilt(7, UP, CAMERA.frame_id)
# Middle (x, y) and radius of spheres half sunk into the ground, m, in the level frame below the camera.
ROCKS = ((3.0, 0.4, 0.3), (4.5, -0.8, 0.4), (6.0, 0.9, 0.3), (2.5, -0.5, 0.2))


_AHEAD = np.array([0, -np.sin(PITCH), np.cos(PITCH)])
LEVEL_FROM_CAMERA = np.stack([_AHEAD, np.cross(UP, _AHEAD), UP])  # the camera looks along level x, PITCH below it
_V, _U = np.mgrid[: CAMERA.height, : CAMERA.width]
_RAYS = np.stack([(_U - CAMERA.cx) / CAMERA.fx, (_V - CAMERA.cy) / CAMERA.fy, np.ones(_U.shape)], axis=-1)
RAYS = _RAYS @ LEVEL_FROM_CAMERA.T


def rocks_seen(rocks: tuple[tuple[float, float, float], ...] = ROCKS) -> Array:
    """Exact disparity (H, W) float64 of the plane z = 0 with rocks; NaN where no ray meets it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(RAYS[..., 2] < 0, -HEIGHT / RAYS[..., 2], np.nan)
        for x, y, radius in rocks:
            middle = np.array([x, y, -HEIGHT])
            a, b, c = (RAYS**2).sum(-1), RAYS @ middle, middle @ middle - radius**2
            depth = np.fmin(depth, (b - np.sqrt(b * b - a * c)) / a)
        return CAMERA.fx * CAMERA.baseline / depth


def profile_seen(profile: Callable[[Array], Array]) -> Array:
    """Exact disparity (H, W) float64 of ground with this height profile ahead, m; NaN beyond 14 m."""
    ahead = np.linspace(0.3, 14, 30_000)
    highest = np.maximum.accumulate((profile(ahead) - HEIGHT) / ahead)  # so far: a ray ends where it meets ground first
    meets = np.searchsorted(highest, RAYS[..., 2] / RAYS[..., 0])
    distance = np.append(ahead, np.nan)[np.minimum(meets, len(ahead))]
    return np.asarray(CAMERA.fx * CAMERA.baseline * RAYS[..., 0] / distance)


def blank_frame(camera: StereoCamera = CAMERA, stamp: int = 7) -> StereoFrame:
    image = np.full((camera.height, camera.width), 90, np.uint8)
    return StereoFrame(stamp, image, image, camera)


FRAME = blank_frame()


def as_disparity(pixels: Array, camera: StereoCamera = CAMERA, stamp: int = 7) -> Disparity:
    return disparity_of(pixels, stamp=stamp, camera=camera)


@dataclass(frozen=True)
class Terrain:
    """A terrain grid with its truth: above_mean, rock height above the ground, m; rock, its index, 0 for none."""

    elevation: ElevationMap
    above_mean: Array
    rock: Array


def rolling_terrain(seed, *, amplitude=0.0, wavelength=6.0, slope=0.0, rocks=12, noise=0.01, cells=160) -> Terrain:
    """Sloping, rolling ground with half-ellipsoid rocks 0.22 to 0.5 m high, averaged over cells, all observed."""
    random, fine, extent = np.random.default_rng(seed), 4, cells * 0.05 / 2
    axis = (np.arange(cells * fine) + 0.5) * 0.05 / fine - extent
    x, y = np.meshgrid(axis, axis)
    heading, px, py = random.uniform(0, 2 * np.pi, 3)
    base = np.tan(slope) * (np.cos(heading) * x + np.sin(heading) * y)
    base += amplitude * np.sin(2 * np.pi * x / wavelength + px) * np.sin(2 * np.pi * y / wavelength + py)
    above, index, placed = np.zeros_like(base), np.zeros(base.shape, int), list[tuple[float, float, float]]()
    while len(placed) < rocks:
        cx, cy = random.uniform(-extent + 0.6, extent - 0.6, 2)
        height = random.uniform(0.22, 0.5)
        radius = height * random.uniform(0.8, 1.2)
        if any(np.hypot(cx - qx, cy - qy) < radius + r + 0.2 for qx, qy, r in placed):
            continue
        placed.append((cx, cy, radius))
        inside = 1 - ((x - cx) ** 2 + (y - cy) ** 2) / radius**2
        above = np.maximum(above, height * np.sqrt(np.maximum(inside, 0)))
        index[inside > 0] = len(placed)

    def blocks(field):
        return field.reshape(cells, fine, cells, fine).swapaxes(1, 2).reshape(cells, cells, -1)

    z, error = blocks(base + above), noise * random.standard_normal((cells, cells))
    layers = {"elevation": z.mean(-1) + error, "minimum": z.min(-1) + error, "maximum": z.max(-1) + error}
    grid = replace(map_of(**layers, count=np.full(error.shape, 16)), stamp=7, origin=(-extent, -extent))
    return Terrain(grid, blocks(above).mean(-1), blocks(index).max(-1))


def grid(cells: int) -> list[Array]:
    """The middles of the cells of a square map, x and y (rows, cols)."""
    axis = (np.arange(cells) + 0.5) * 0.05
    return list(np.meshgrid(axis, axis))


def map_of(elevation: Array, resolution: float = 0.05, **layers: Array) -> ElevationMap:
    named = {"elevation": elevation, **layers}
    return ElevationMap(1, {k: v.astype(np.float32) for k, v in named.items()}, resolution, (0.0, 0.0), "level")
