"""The light at the pixels of the simulator: sunlight on texture, cast shadows, and haze."""

from __future__ import annotations

from math import exp, floor, inf, sqrt
from typing import Any

from recordings.simulator.raycast import GROUND, ROUNDED, SKY, first_hit
from recordings.simulator.texture import TerrainClass, ground_look, rock_albedo
from stages.compiled.jit import borrowing_kernel

VISIBILITY = 300.0  # m, at which haze leaves 1/e of the contrast
SUNLIGHT = 0.86
_NO_GROUND, _ROCK = int(TerrainClass.SKY), int(TerrainClass.ROCK)


@borrowing_kernel
def _upward(ground: Any, resolution: float, x: float, y: float) -> tuple[float, float, float]:
    """Normal, not of unit length, of the ground smoothed over two cells."""
    mask = ground.shape[0] - 1
    gx, gy = x / resolution, y / resolution
    ix, iy = floor(gx), floor(gy)
    u, v = gx - ix, gy - iy
    i0, i1, i2, i3 = (iy - 1) & mask, iy & mask, (iy + 1) & mask, (iy + 2) & mask
    j0, j1, j2, j3 = (ix - 1) & mask, ix & mask, (ix + 1) & mask, (ix + 2) & mask
    h11, h12, h21, h22 = ground[i1, j1], ground[i1, j2], ground[i2, j1], ground[i2, j2]
    west = ((h12 - ground[i1, j0]) * (1 - v) + (h22 - ground[i2, j0]) * v) * (1 - u)
    east = ((ground[i1, j3] - h11) * (1 - v) + (ground[i2, j3] - h21) * v) * u
    south = ((h21 - ground[i0, j1]) * (1 - u) + (h22 - ground[i0, j2]) * u) * (1 - v)
    north = ((ground[i3, j1] - h11) * (1 - u) + (ground[i3, j2] - h12) * u) * v
    return -(west + east), -(south + north), 2 * resolution


@borrowing_kernel
def _nearest_repetition(value: float, near: float, extent: float) -> float:
    """The value + k * extent nearest to `near`."""
    return value + extent * floor((near - value) / extent + 0.5)


@borrowing_kernel
def _normal_at(scn: Any, surface: int, facet: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Unit normal, towards the outside, of the surface at a point that a ray has hit.

    The ground is smoothed over neighbouring patches, so bilinear seams are invisible.
    """
    if surface == GROUND:
        nx, ny, nz = _upward(scn.ground, scn.resolution, x, y)
    else:
        solid = scn.rocks[surface]
        c, s = solid[6], solid[7]
        if facet == ROUNDED:
            extent = scn.ground.shape[0] * scn.resolution
            ox = x - _nearest_repetition(solid[0], x, extent)
            oy = y - _nearest_repetition(solid[1], y, extent)
            qx, qy, qz = (c * ox + s * oy) * solid[3], (c * oy - s * ox) * solid[4], (z - solid[2]) * solid[5]
        else:
            plane = scn.facets[scn.shapes[surface], facet]
            qx, qy, qz = plane[0], plane[1], plane[2]
        ex, ey = qx * solid[3], qy * solid[4]
        nx, ny, nz = c * ex - s * ey, s * ex + c * ey, qz * solid[5]
    length = sqrt(nx * nx + ny * ny + nz * nz)
    return nx / length, ny / length, nz / length


@borrowing_kernel
def shade_rows(
    scn: Any, texture: Any, sun: Any, skylight: float, origin: Any, rotation: Any, fx: float, fy: float,
    cx: float, cy: float, first: int, depth: Any, surface: Any, facet: Any, radiance: Any, kind: Any,
) -> None:  # fmt: skip
    """Light at the pixels of `cast_rows` (same arguments): radiance (rows, W, 3) float32, about 0 to 1.

    sun: (3,) towards it; skylight: light of the whole sky, which fills shadows; kind: (rows, W) uint8, the
    `TerrainClass` of each pixel.
    """
    for row in range(depth.shape[0]):
        b = (first + row - cy) / fy
        for column in range(depth.shape[1]):
            a = (column - cx) / fx
            dx = rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2]
            dy = rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2]
            dz = rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2]
            speed = sqrt(dx * dx + dy * dy + dz * dz)
            t, what = depth[row, column], surface[row, column]
            up = min(max(dz / speed, 0.0) * 2.5, 1.0)
            sky0, sky1, sky2 = 0.86 - 0.12 * up, 0.76 - 0.12 * up, 0.65 - 0.07 * up
            if t == inf:
                radiance[row, column, 0], radiance[row, column, 1], radiance[row, column, 2] = sky0, sky1, sky2
                kind[row, column] = _NO_GROUND
                continue
            x, y, z = origin[0] + t * dx, origin[1] + t * dy, origin[2] + t * dz
            nx, ny, nz = _normal_at(scn, what, facet[row, column], x, y, z)
            facing = max(-(nx * dx + ny * dy + nz * dz) / speed, 0.03)
            width = t / fx
            if what == GROUND:
                flat = sqrt(dx * dx + dy * dy) + 1e-12
                grit, albedo, bare, cover = ground_look(texture, x, y, width, width / facing, dx / flat, dy / flat)
                red, green, blue = (0.66 - 0.06 * bare) * albedo, 0.47 * albedo, (0.34 + 0.03 * bare) * albedo
            else:
                grit, cover = 1.0, _ROCK
                albedo = rock_albedo(texture, what, x, y, z, nx, ny, nz, width / sqrt(facing))
                red, green, blue = 0.60 * albedo, 0.46 * albedo, 0.37 * albedo
            kind[row, column] = cover
            toward = nx * sun[0] + ny * sun[1] + nz * sun[2]
            light = 0.0
            if toward > 0:
                lift = 0.001 + 1e-4 * t
                x, y, z = x + lift * nx, y + lift * ny, z + lift * nz
                if first_hit(scn, x, y, z, sun[0], sun[1], sun[2], 80.0)[1] == SKY:
                    # Half Lambert, half Lommel-Seeliger, as dusty surfaces scatter (McEwen 1991).
                    light = SUNLIGHT * grit * (0.5 * toward + toward / (toward + facing))
            light += skylight * (0.5 + 0.5 * nz) * (1 + 0.4 * (grit - 1))
            through = exp(-t * speed / VISIBILITY)
            radiance[row, column, 0] = red * light * through + sky0 * (1 - through)
            radiance[row, column, 1] = green * light * through + sky1 * (1 - through)
            radiance[row, column, 2] = blue * light * through + sky2 * (1 - through)
