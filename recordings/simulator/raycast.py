"""Rays against the simulator's terrain: exact first hits with bilinear ground and with cut ellipsoids.

Both are walked through a pyramid of maxima (Tevs et al. 2008): a ray that stays above the highest point of a block
crosses it in one step, however large the block; in the last block the hit is a quadratic's root, so no step size limits
the accuracy. All coordinates are world metres; the terrain repeats without end.
"""

from __future__ import annotations

from collections.abc import Callable
from math import floor, inf, sqrt
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from stages.data import Array

# One bucket of rocks spans 2**BUCKET_LEVEL ground cells.
BUCKET_LEVEL = 3
SKY = -2
GROUND = -1
# Blocks are looked up this far (m) past their border, so that a ray on a border enters the next block.
NUDGE = 1e-7
ROUNDED = -1


class Scene(NamedTuple):
    """Terrain as the compiled loops read it.

    ground: (n, n) float32 nodes, m; resolution: m; tops, levels: flat pyramid of block maxima of the ground and where
    each level begins; rock_tops, rock_levels: the same over buckets of rocks; rocks: (N, 8) centre, inverse semi-axes,
    cosine and sine of yaw; shapes: (N,) int32; facets: (S, F, 4) planes in the rock's unit space; bucket_start,
    bucket_rocks: int32, the rocks of each bucket; ceiling: m, above everything.
    """

    ground: Array
    resolution: float
    tops: Array
    levels: Array
    rock_tops: Array
    rock_levels: Array
    rocks: Array
    shapes: Array
    facets: Array
    bucket_start: Array
    bucket_rocks: Array
    ceiling: float


def pyramid_of(finest: Array, reduction: Callable[..., Array] = np.max) -> tuple[Array, Array]:
    """A square array reduced over blocks of 1, 2, 4, ... cells: flat float32, and where each level begins."""
    levels = [finest]
    while len(levels[-1]) > 1:
        half = len(levels[-1]) // 2
        levels.append(reduction(levels[-1].reshape(half, 2, half, 2), axis=(1, 3)))
    starts = np.concatenate([[0], np.cumsum([level.size for level in levels])]).astype(np.int64)
    return np.concatenate([level.ravel() for level in levels]).astype(np.float32), starts


def scene(
    ground: Array, resolution: float, patch_tops: Array, bucket_tops: Array, rocks: Array, shapes: Array, facets: Array,
    bucket_start: Array, bucket_rocks: Array,
) -> Scene:  # fmt: skip
    """The scene of a ground tile (n, n), the maxima of its patches and of its rock buckets, and its rocks."""
    tops, levels = pyramid_of(patch_tops)
    rock_tops, rock_levels = pyramid_of(bucket_tops)
    return Scene(
        np.ascontiguousarray(ground, dtype=np.float32), float(resolution), tops, levels, rock_tops, rock_levels,
        np.ascontiguousarray(rocks, dtype=np.float64), shapes, np.ascontiguousarray(facets, dtype=np.float64),
        bucket_start, bucket_rocks, float(max(tops[-1], rock_tops[-1])) + 1.0,
    )  # fmt: skip


@njit(nogil=True, cache=True)
def height_at(ground: Any, resolution: float, x: float, y: float) -> float:
    """Bilinear ground elevation at one point."""
    mask = ground.shape[0] - 1
    gx, gy = x / resolution, y / resolution
    ix, iy = floor(gx), floor(gy)
    u, v = gx - ix, gy - iy
    i, j, i1, j1 = iy & mask, ix & mask, (iy + 1) & mask, (ix + 1) & mask
    low = ground[i, j] * (1 - u) + ground[i, j1] * u
    return float(low * (1 - v) + (ground[i1, j] * (1 - u) + ground[i1, j1] * u) * v)


@njit(nogil=True, cache=True)
def heights_at(ground: Any, resolution: float, x: Any, y: Any) -> Any:
    """Bilinear ground elevation (N,) float64 at points x, y (N,)."""
    out = np.empty(x.shape[0])
    for k in range(x.shape[0]):
        out[k] = height_at(ground, resolution, x[k], y[k])
    return out


@njit(nogil=True, cache=True)
def nearest_repetition(value: float, near: float, extent: float) -> float:
    """The one of value + k * extent that lies nearest to `near`."""
    return value + extent * floor((near - value) / extent + 0.5)


@njit(nogil=True, cache=True)
def _exit(position: float, inverse: float, index: int, size: float) -> float:
    """Distance at which a ray leaves block `index` along one axis."""
    if inverse == inf or inverse == -inf:
        return inf
    return ((index + 1) * size - position) * inverse if inverse > 0 else (index * size - position) * inverse


@njit(nogil=True, cache=True)
def _patch_hit(
    scn: Any, ix: int, iy: int, u: float, v: float, z: float, gx: float, gy: float, dz: float, length: float
) -> float:
    """First root in [0, length] of ray minus patch; inf if none. u, v: entry in the patch; gx, gy: cells a metre."""
    mask = scn.ground.shape[0] - 1
    i, j, i1, j1 = iy & mask, ix & mask, (iy + 1) & mask, (ix + 1) & mask
    h00, h10 = float(scn.ground[i, j]), float(scn.ground[i, j1])
    h01, h11 = float(scn.ground[i1, j]), float(scn.ground[i1, j1])
    b, c, d = h10 - h00, h01 - h00, h11 - h10 - h01 + h00
    at = z - (h00 + b * u + c * v + d * u * v)
    if at <= 0.0:
        return 0.0
    linear = dz - b * gx - c * gy - d * (u * gy + v * gx)
    square = -d * gx * gy
    if abs(square) * length < 1e-12 * (abs(linear) + 1e-30):
        root = -at / linear if linear < 0 else inf
        return root if root <= length else inf
    root2 = linear * linear - 4 * square * at
    if root2 < 0:
        return inf
    # The form of Citardauq loses no digits where the quadratic is nearly a line.
    q = -0.5 * (linear + (sqrt(root2) if linear > 0 else -sqrt(root2)))
    first, second = q / square, (at / q if q != 0 else inf)
    if first > second:
        first, second = second, first
    root = first if first >= 0 else second
    return root if 0 <= root <= length else inf


@njit(nogil=True, cache=True)
def _ground_hit(
    scn: Any, px: float, py: float, pz: float, dx: float, dy: float, dz: float, start: float, far: float
) -> float:
    """Distance to the first ground in (start, far), inf if none."""
    n, step, inverse_step = scn.ground.shape[0], scn.resolution, 1 / scn.resolution
    highest = scn.levels.shape[0] - 2
    inverse_x = 1 / dx if dx != 0 else inf
    inverse_y = 1 / dy if dy != 0 else inf
    t, level = start, min(3, highest)
    ceiling = scn.tops[scn.levels[highest]]
    while t < far:
        if dz >= 0 and pz + dz * t > ceiling:
            return inf
        size, per_metre = step * (1 << level), inverse_step / (1 << level)
        ix = floor((px + dx * (t + NUDGE)) * per_metre)
        iy = floor((py + dy * (t + NUDGE)) * per_metre)
        leave = max(min(_exit(px, inverse_x, ix, size), _exit(py, inverse_y, iy, size), far), t + NUDGE)
        width = n >> level
        top = scn.tops[scn.levels[level] + (iy & (width - 1)) * width + (ix & (width - 1))]
        if pz + dz * (leave if dz < 0 else t) > top:
            t = leave
            level = min(level + 1, highest)
        elif level > 0:
            level -= 1
        else:
            x, y = (px + dx * t) / step - ix, (py + dy * t) / step - iy
            hit = _patch_hit(scn, ix, iy, x, y, pz + dz * t, dx / step, dy / step, dz, leave - t)
            if hit < inf:
                return t + hit
            t = leave
            level = 1
    return inf


@njit(nogil=True, cache=True)
def _rock_hit(
    scn: Any, rock: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float
) -> tuple[float, int]:
    """Where a ray enters one rock and through which facet (ROUNDED: the ellipsoid); inf if it misses.

    ox, oy, oz: the ray's origin from the rock's centre. A ray from inside the rock does not enter it.
    """
    solid = scn.rocks[rock]
    ax, ay, az, c, s = solid[3], solid[4], solid[5], solid[6], solid[7]
    qx, qy, qz = (c * ox + s * oy) * ax, (c * oy - s * ox) * ay, oz * az
    ex, ey, ez = (c * dx + s * dy) * ax, (c * dy - s * dx) * ay, dz * az
    a = ex * ex + ey * ey + ez * ez
    b = qx * ex + qy * ey + qz * ez
    disc = b * b - a * (qx * qx + qy * qy + qz * qz - 1)
    if disc <= 0:
        return inf, ROUNDED
    root = sqrt(disc)
    enter, leave, facet = (-b - root) / a, (-b + root) / a, ROUNDED
    if leave <= 0:
        return inf, ROUNDED
    planes = scn.facets[scn.shapes[rock]]
    for k in range(planes.shape[0]):
        along = planes[k, 0] * ex + planes[k, 1] * ey + planes[k, 2] * ez
        room = planes[k, 3] - (planes[k, 0] * qx + planes[k, 1] * qy + planes[k, 2] * qz)
        if along < 0:
            if room / along > enter:
                enter, facet = room / along, k
        elif along > 0:
            leave = min(leave, room / along)
        elif room < 0:
            return inf, ROUNDED
        if enter >= leave:
            return inf, ROUNDED
    return (enter, facet) if enter > 0 else (inf, ROUNDED)


@njit(nogil=True, cache=True)
def _rocks_hit(
    scn: Any, px: float, py: float, pz: float, dx: float, dy: float, dz: float, start: float, far: float
) -> tuple[float, int, int]:
    """Distance, index and facet of the first rock in (start, far); inf if none."""
    n = scn.ground.shape[0] >> BUCKET_LEVEL
    step, highest = scn.resolution * (1 << BUCKET_LEVEL), scn.rock_levels.shape[0] - 2
    extent, inverse_step = n * step, 1 / step
    inverse_x = 1 / dx if dx != 0 else inf
    inverse_y = 1 / dy if dy != 0 else inf
    best, best_rock, best_facet = far, SKY, ROUNDED
    t, level = start, 0
    ceiling = scn.rock_tops[scn.rock_levels[highest]]
    while t < best:
        if dz >= 0 and pz + dz * t > ceiling:
            break
        size, per_metre = step * (1 << level), inverse_step / (1 << level)
        ix = floor((px + dx * (t + NUDGE)) * per_metre)
        iy = floor((py + dy * (t + NUDGE)) * per_metre)
        leave = max(min(_exit(px, inverse_x, ix, size), _exit(py, inverse_y, iy, size), far), t + NUDGE)
        width = n >> level
        block = (iy & (width - 1)) * width + (ix & (width - 1))
        if pz + dz * (leave if dz < 0 else t) > scn.rock_tops[scn.rock_levels[level] + block]:
            t = leave
            level = min(level + 1, highest)
        elif level > 0:
            level -= 1
        else:
            for k in range(scn.bucket_start[block], scn.bucket_start[block + 1]):
                rock = scn.bucket_rocks[k]
                cx = nearest_repetition(scn.rocks[rock, 0], (ix + 0.5) * step, extent)
                cy = nearest_repetition(scn.rocks[rock, 1], (iy + 0.5) * step, extent)
                hit, facet = _rock_hit(scn, rock, px - cx, py - cy, pz - scn.rocks[rock, 2], dx, dy, dz)
                if start < hit < best:
                    best, best_rock, best_facet = hit, rock, facet
            t = leave
    if best_rock == SKY:
        return inf, SKY, ROUNDED
    return best, best_rock, best_facet


@njit(nogil=True, cache=True)
def first_hit(
    scn: Any, px: float, py: float, pz: float, dx: float, dy: float, dz: float, start: float, far: float
) -> tuple[float, int, int]:
    """Distance (in lengths of the direction), surface (GROUND, SKY or a rock's index) and facet of the first hit."""
    ground = _ground_hit(scn, px, py, pz, dx, dy, dz, start, far)
    rock_t, rock, facet = _rocks_hit(scn, px, py, pz, dx, dy, dz, start, min(ground, far))
    if rock != SKY:
        return rock_t, rock, facet
    return ground, (GROUND if ground < inf else SKY), ROUNDED


@njit(nogil=True, cache=True)
def is_hidden(
    scn: Any, px: float, py: float, pz: float, dx: float, dy: float, dz: float, start: float, far: float
) -> bool:
    """Whether anything lies on the ray between the distances `start` and `far`."""
    if _ground_hit(scn, px, py, pz, dx, dy, dz, start, far) < inf:
        return True
    return bool(_rocks_hit(scn, px, py, pz, dx, dy, dz, start, far)[1] != SKY)


@njit(nogil=True, cache=True)
def normal_at(scn: Any, surface: int, facet: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Unit normal, towards the outside, of the surface at a point that a ray has hit.

    The ground's is smoothed over neighbouring patches, so that bilinear seams do not show in the light.
    """
    if surface == GROUND:
        step = scn.resolution
        right, left = height_at(scn.ground, step, x + step, y), height_at(scn.ground, step, x - step, y)
        ahead, behind = height_at(scn.ground, step, x, y + step), height_at(scn.ground, step, x, y - step)
        nx, ny, nz = (left - right) / (2 * step), (behind - ahead) / (2 * step), 1.0
    else:
        solid = scn.rocks[surface]
        c, s = solid[6], solid[7]
        if facet == ROUNDED:
            extent = scn.ground.shape[0] * scn.resolution
            ox = x - nearest_repetition(solid[0], x, extent)
            oy = y - nearest_repetition(solid[1], y, extent)
            qx, qy, qz = (c * ox + s * oy) * solid[3], (c * oy - s * ox) * solid[4], (z - solid[2]) * solid[5]
        else:
            plane = scn.facets[scn.shapes[surface], facet]
            qx, qy, qz = plane[0], plane[1], plane[2]
        ex, ey = qx * solid[3], qy * solid[4]
        nx, ny, nz = c * ex - s * ey, s * ex + c * ey, qz * solid[5]
    length = sqrt(nx * nx + ny * ny + nz * nz)
    return nx / length, ny / length, nz / length


@njit(nogil=True, cache=True)
def tops_at(scn: Any, x: Any, y: Any, ceiling: float) -> Any:
    """What one meets from above at points x, y (N,): elevation (N,) float64, m, and surface (N,) int32.

    ceiling: m, any height above all rocks.
    """
    z, surface = np.empty(x.shape[0]), np.empty(x.shape[0], np.int32)
    for k in range(x.shape[0]):
        ground = height_at(scn.ground, scn.resolution, x[k], y[k])
        t, rock, _ = _rocks_hit(scn, x[k], y[k], ceiling, 0.0, 0.0, -1.0, 0.0, ceiling - ground)
        z[k] = ground if rock == SKY else ceiling - t
        surface[k] = GROUND if rock == SKY else rock
    return z, surface


@njit(nogil=True, cache=True)
def cast_rows(
    scn: Any, origin: Any, rotation: Any, fx: float, fy: float, cx: float, cy: float, far: float, first: int,
    depth: Any, surface: Any, facet: Any,
) -> None:  # fmt: skip
    """First hits of a camera's pixel rows, from row `first`, into the row blocks depth, surface and facet.

    origin: (3,) the camera, m; rotation: (3, 3) world from optical; depth: (rows, W) float64, m along the optical axis,
    inf for sky; surface: (rows, W) int32; facet: (rows, W) int8. far: m along the optical axis.
    """
    for row in range(depth.shape[0]):
        b = (first + row - cy) / fy
        for column in range(depth.shape[1]):
            a = (column - cx) / fx
            dx = rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2]
            dy = rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2]
            dz = rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2]
            t, what, side = first_hit(scn, origin[0], origin[1], origin[2], dx, dy, dz, 0.0, far)
            depth[row, column], surface[row, column], facet[row, column] = t, what, side


@njit(nogil=True, cache=True)
def seen_rows(
    scn: Any, left: Any, right: Any, rotation: Any, fx: float, fy: float, cx: float, cy: float, first: int,
    depth: Any, seen: Any,
) -> None:  # fmt: skip
    """Which hits of `cast_rows` the right camera sees too, into seen (rows, W) uint8.

    255 seen by both, 128 hidden from the right camera or outside its image, 0 no surface. left, right: (3,) cameras, m.
    """
    baseline = sqrt((right[0] - left[0]) ** 2 + (right[1] - left[1]) ** 2 + (right[2] - left[2]) ** 2)
    width = depth.shape[1]
    for row in range(depth.shape[0]):
        b = (first + row - cy) / fy
        for column in range(width):
            t = depth[row, column]
            if t == inf:
                seen[row, column] = 0
                continue
            seen[row, column] = 128
            if column - fx * baseline / t < -0.5:
                continue
            a = (column - cx) / fx
            # From the right camera, at unit speed along the optical axis, the point is met at t:
            # what is met sooner hides it.
            dx = rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2] - (right[0] - left[0]) / t
            dy = rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2] - (right[1] - left[1]) / t
            dz = rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2] - (right[2] - left[2]) / t
            if not is_hidden(scn, right[0], right[1], right[2], dx, dy, dz, 0.0, t * (1 - 1e-5) - 1e-5):
                seen[row, column] = 255
