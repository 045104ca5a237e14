"""Rays against the simulator's terrain: exact first hits with bilinear ground and with cut ellipsoids.

Rays walk through a pyramid of maxima (Tevs et al. 2008): a ray above the highest point of a block crosses it in one
step. In the last block the hit is the root of a quadratic, so no step size limits the accuracy. All coordinates are
world metres; the terrain repeats without end.
"""

from __future__ import annotations

from collections.abc import Callable
from math import floor, inf, sqrt
from typing import Any, NamedTuple

import numpy as np

from stages.compiled.jit import borrowing_kernel, typed_kernel
from stages.data import Array

# One bucket of rocks spans 2**BUCKET_LEVEL ground cells.
BUCKET_LEVEL = 1
SKY = -2
GROUND = -1
ROUNDED = -1


class Scene(NamedTuple):
    """The terrain for the compiled loops.

    ground: (n, n) float32 nodes, m; resolution: m; tops, levels: flat pyramid of the highest points, rocks included, of
    blocks of cells and where each level begins; rocks: (N, 8) centre in the tile, inverse semi-axes, cosine and sine
    of yaw; shapes: (N,) int32; facets: (S, F, 4) planes in the rock's unit space; bucket_start, bucket_rocks: int32,
    the rocks of each bucket; ceiling: m, above everything.
    """

    ground: Array
    resolution: float
    tops: Array
    levels: Array
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
    size = 1 << BUCKET_LEVEL
    tops, levels = pyramid_of(np.maximum(patch_tops, bucket_tops.repeat(size, axis=0).repeat(size, axis=1)))
    return Scene(
        np.ascontiguousarray(ground, dtype=np.float32), float(resolution), tops, levels,
        np.ascontiguousarray(rocks, dtype=np.float64), shapes, np.ascontiguousarray(facets, dtype=np.float64),
        bucket_start, bucket_rocks, float(tops[-1]) + 1.0,
    )  # fmt: skip


@borrowing_kernel
def height_at(ground: Any, resolution: float, x: float, y: float) -> float:
    """Bilinear ground elevation at one point."""
    mask = ground.shape[0] - 1
    gx, gy = x / resolution, y / resolution
    ix, iy = floor(gx), floor(gy)
    u, v = gx - ix, gy - iy
    i, j, i1, j1 = iy & mask, ix & mask, (iy + 1) & mask, (ix + 1) & mask
    low = ground[i, j] * (1 - u) + ground[i, j1] * u
    return float(low * (1 - v) + (ground[i1, j] * (1 - u) + ground[i1, j1] * u) * v)


@typed_kernel
def heights_at(ground: Any, resolution: float, x: Any, y: Any) -> Any:
    """Bilinear ground elevation (N,) float64 at points x, y (N,)."""
    out = np.empty(x.shape[0])
    for k in range(x.shape[0]):
        out[k] = height_at(ground, resolution, x[k], y[k])
    return out


@borrowing_kernel
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
    # The Citardauq form stays exact for a nearly linear quadratic.
    q = -0.5 * (linear + (sqrt(root2) if linear > 0 else -sqrt(root2)))
    first, second = q / square, (at / q if q != 0 else inf)
    if first > second:
        first, second = second, first
    root = first if first >= 0 else second
    return root if 0 <= root <= length else inf


@borrowing_kernel
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
            if room < enter * along:
                enter, facet = room / along, k
        elif room < leave * along:
            leave = room / along
        elif along == 0 and room < 0:
            return inf, ROUNDED
        if enter >= leave:
            return inf, ROUNDED
    return (enter, facet) if enter > 0 else (inf, ROUNDED)


@borrowing_kernel
def _bucket_hit(
    scn: Any, bucket: int, x: float, y: float, px: float, py: float, pz: float, dx: float, dy: float, dz: float,
    far: float,
) -> tuple[float, int, int]:  # fmt: skip
    """Distance, index and facet of the first hit in (0, far) of a rock of the bucket about (x, y); SKY if none."""
    extent = scn.ground.shape[0] * scn.resolution
    tile_x, tile_y, half = extent * floor(x / extent), extent * floor(y / extent), extent / 2
    best, best_rock, best_facet = far, SKY, ROUNDED
    for k in range(scn.bucket_start[bucket], scn.bucket_start[bucket + 1]):
        rock = scn.bucket_rocks[k]
        cx, cy = scn.rocks[rock, 0] + tile_x, scn.rocks[rock, 1] + tile_y
        cx += extent if cx < x - half else (-extent if cx > x + half else 0.0)
        cy += extent if cy < y - half else (-extent if cy > y + half else 0.0)
        hit, facet = _rock_hit(scn, rock, px - cx, py - cy, pz - scn.rocks[rock, 2], dx, dy, dz)
        if 0.0 < hit < best:
            best, best_rock, best_facet = hit, rock, facet
    return best, best_rock, best_facet


@borrowing_kernel
def first_hit(
    scn: Any, px: float, py: float, pz: float, dx: float, dy: float, dz: float, far: float
) -> tuple[float, int, int]:
    """Distance (in lengths of the direction), surface (GROUND, SKY or a rock's index) and facet of the first hit."""
    n, step = scn.ground.shape[0], scn.resolution
    highest = scn.levels.shape[0] - 2
    # In cells, as everything below except z.
    per_metre = 1 / step
    gx, gy, ux, uy = px * per_metre, py * per_metre, dx * per_metre, dy * per_metre
    inverse_x, inverse_y = 1 / ux, 1 / uy
    ahead_x, ahead_y = (1 if ux >= 0 else 0), (1 if uy >= 0 else 0)
    if ux == 0:
        inverse_x = inf
    if uy == 0:
        inverse_y = inf
    best, surface, facet = far, SKY, ROUNDED
    t, level, tested = 0.0, 0, -1
    ix, iy = floor(gx), floor(gy)
    while t < best:
        if dz >= 0 and pz + dz * t > scn.ceiling:
            break
        bx, by = ix >> level, iy >> level
        border_x, border_y = (bx + ahead_x) << level, (by + ahead_y) << level
        leave_x, leave_y = (border_x - gx) * inverse_x, (border_y - gy) * inverse_y
        leave = min(leave_x, leave_y)
        width = n >> level
        top = scn.tops[scn.levels[level] + (by & (width - 1)) * width + (bx & (width - 1))]
        if pz + dz * (min(leave, best) if dz < 0 else t) <= top:
            if level > 0:
                level -= 1
                continue
            half = n >> BUCKET_LEVEL
            bucket = ((iy >> BUCKET_LEVEL) & (half - 1)) * half + ((ix >> BUCKET_LEVEL) & (half - 1))
            if bucket != tested and scn.bucket_start[bucket] < scn.bucket_start[bucket + 1]:
                hit, rock, side = _bucket_hit(
                    scn, bucket, (ix + 0.5) * step, (iy + 0.5) * step, px, py, pz, dx, dy, dz, best
                )  # fmt: skip
                if rock != SKY:
                    best, surface, facet = hit, rock, side
            tested = bucket
            hit = _patch_hit(scn, ix, iy, gx + ux * t - ix, gy + uy * t - iy, pz + dz * t, ux, uy, dz, leave - t)
            if t + hit < best:
                best, surface, facet = t + hit, GROUND, ROUNDED
                break
        t = max(t, leave)
        if leave_x < leave_y:
            ix = border_x - 1 + ahead_x
            iy = min(max(floor(gy + uy * t), by << level), ((by + 1) << level) - 1)
            if (bx & 1) == ahead_x and level < highest:
                level += 1
        else:
            iy = border_y - 1 + ahead_y
            ix = min(max(floor(gx + ux * t), bx << level), ((bx + 1) << level) - 1)
            if (by & 1) == ahead_y and level < highest:
                level += 1
    return (best if surface != SKY else inf), surface, facet


@typed_kernel
def tops_at(scn: Any, x: Any, y: Any, ceiling: float) -> Any:
    """The first hit from above at points x, y (N,): elevation (N,) float64, m, and surface (N,) int32.

    ceiling: m, any height above all rocks.
    """
    z, surface = np.empty(x.shape[0]), np.empty(x.shape[0], np.int32)
    for k in range(x.shape[0]):
        t, surface[k], _ = first_hit(scn, x[k], y[k], ceiling, 0.0, 0.0, -1.0, 1e6)
        z[k] = ceiling - t
    return z, surface


@borrowing_kernel
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
            t, what, side = first_hit(scn, origin[0], origin[1], origin[2], dx, dy, dz, far)
            depth[row, column], surface[row, column], facet[row, column] = t, what, side


@borrowing_kernel
def seen_rows(
    scn: Any, left: Any, right: Any, rotation: Any, fx: float, fy: float, cx: float, cy: float, first: int,
    depth: Any, height: int, row_offset: float, seen: Any,
) -> None:  # fmt: skip
    """Which hits of `cast_rows` the right camera sees too, into seen (rows, W) uint8.

    255 seen by both, 128 hidden from the right camera or outside its image, 0 no surface. left, right: (3,) cameras, m;
    height: of the images, px; row_offset: of the right image's rows, px.
    """
    baseline = sqrt((right[0] - left[0]) ** 2 + (right[1] - left[1]) ** 2 + (right[2] - left[2]) ** 2)
    width = depth.shape[1]
    for row in range(depth.shape[0]):
        b, place = (first + row - cy) / fy, first + row + row_offset + 0.5
        for column in range(width):
            t = depth[row, column]
            if t == inf:
                seen[row, column] = 0
                continue
            seen[row, column] = 128
            if column - fx * baseline / t + 0.5 < 0 or place < 0 or place > height:
                continue
            a = (column - cx) / fx
            # From the right camera, at unit speed along the optical axis, the ray reaches the point at t:
            # an earlier hit hides it.
            nearness = 1 / t
            dx = rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2] - (right[0] - left[0]) * nearness
            dy = rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2] - (right[1] - left[1]) * nearness
            dz = rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2] - (right[2] - left[2]) * nearness
            if first_hit(scn, right[0], right[1], right[2], dx, dy, dz, t * (1 - 1e-5) - 1e-5)[1] == SKY:
                seen[row, column] = 255
