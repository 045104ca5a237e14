"""Scenes with ground truth for the terrain tests: a plane with rocks in a camera's view, and terrain grids."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stages.data import Array, Disparity, ElevationMap, PixelOrigin, StereoCamera, StereoFrame

# The Devon Island camera at half size.
CAMERA = StereoCamera(484.5, 484.5, 317.3, 231.5, 0.24, 640, 480)
HEIGHT, PITCH = 1.0, np.deg2rad(15.0)
UP = np.array([0.0, -np.cos(PITCH), -np.sin(PITCH)])
# Middle (x, y) and radius of spheres half sunk into the ground, m, in the level frame below the camera.
ROCKS = ((3.0, 0.4, 0.3), (4.5, -0.8, 0.4), (6.0, 0.9, 0.3), (2.5, -0.5, 0.2))


def level_from_camera() -> Array:
    """Rotation: the camera looks along level x, PITCH below the horizon."""
    x = np.array([0, -np.sin(PITCH), np.cos(PITCH)])
    return np.stack([x, np.cross(UP, x), UP])


def seen_disparity(rocks: tuple[tuple[float, float, float], ...] = ROCKS, camera: StereoCamera = CAMERA) -> Array:
    """Exact disparity (H, W) float64 of the plane z = 0 with rocks; NaN where no ray meets it."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    rays = rays @ level_from_camera().T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(rays[..., 2] < 0, -HEIGHT / rays[..., 2], np.nan)
        for x, y, radius in rocks:
            middle = np.array([x, y, -HEIGHT])
            a, b, c = (rays**2).sum(-1), rays @ middle, middle @ middle - radius**2
            hit = (b - np.sqrt(b * b - a * c)) / a
            depth = np.fmin(depth, hit)
        return camera.fx * camera.baseline / depth


def profile_disparity(profile: Callable[[Array], Array], camera: StereoCamera = CAMERA) -> Array:
    """Exact disparity (H, W) float64 of ground with this height profile ahead, m; NaN beyond 14 m."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    rays = rays @ level_from_camera().T
    ahead = np.linspace(0.3, 14, 30_000)
    highest = np.maximum.accumulate((profile(ahead) - HEIGHT) / ahead)  # so far: a ray ends where it meets ground first
    meets = np.searchsorted(highest, rays[..., 2] / rays[..., 0])
    distance = np.append(ahead, np.nan)[np.minimum(meets, len(ahead))]
    return camera.fx * camera.baseline * rays[..., 0] / distance  # type: ignore[no-any-return]


def blank_frame(camera: StereoCamera = CAMERA, stamp: int = 7) -> StereoFrame:
    image = np.full((camera.height, camera.width), 90, np.uint8)
    return StereoFrame(stamp, image, image, camera)


def as_disparity(pixels: Array, camera: StereoCamera = CAMERA, stamp: int = 7) -> Disparity:
    known = np.isfinite(pixels)
    source = np.where(known, PixelOrigin.MEASURED, PixelOrigin.UNKNOWN).astype(np.uint8)
    return Disparity(stamp, pixels.astype(np.float32), source, known.astype(np.float32), camera=camera)


@dataclass(frozen=True)
class Terrain:
    """A terrain grid with its truth: above_mean, rock height above the ground, m; rock, its index, 0 for none."""

    elevation: ElevationMap
    above_mean: Array
    rock: Array


def rolling_terrain(
    seed: int,
    *,
    amplitude: float = 0.0,
    wavelength: float = 6.0,
    slope: float = 0.0,
    rocks: int = 12,
    noise: float = 0.01,
    cells: int = 160,
    resolution: float = 0.05,
) -> Terrain:
    """Sloping, rolling ground with half-ellipsoid rocks 0.22 to 0.5 m high, averaged over cells, all observed."""
    random = np.random.default_rng(seed)
    fine = 4
    extent = cells * resolution / 2
    axis = (np.arange(cells * fine) + 0.5) * resolution / fine - extent
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

    def blocks(field: Array) -> Array:
        return field.reshape(cells, fine, cells, fine).swapaxes(1, 2).reshape(cells, cells, -1)

    z = blocks(base + above)
    error = noise * random.standard_normal((cells, cells))
    layers = {"elevation": z.mean(-1), "minimum": z.min(-1), "maximum": z.max(-1)}
    published = {name: (layer + error).astype(np.float32) for name, layer in layers.items()}
    published["count"] = np.full((cells, cells), 16, np.float32)
    grid = ElevationMap(7, published, resolution, (-extent, -extent), "level")
    return Terrain(grid, blocks(above).mean(-1), blocks(index).max(-1))


def map_of(elevation: Array, resolution: float = 0.05, **layers: Array) -> ElevationMap:
    named = {"elevation": elevation, **layers}
    return ElevationMap(1, {k: v.astype(np.float32) for k, v in named.items()}, resolution, (0.0, 0.0), "level")
