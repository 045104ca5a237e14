"""The exact truth of a simulated frame: disparities, maps with their visibility, and rocks.

Disparity comes from the rays of the left image. Elevation and hazards come from vertical rays onto the cell centres, in
the level frame of the true tilt. The region is what is within 8 m of base_link, horizontally, or of the left camera. A
cell is in view if a line of sight from each camera reaches any of nine points of its surface, whether or not a pixel is
on that line: a map may have values between pixels, but not behind an obstacle.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from recordings.ros2.to_msg import exact_disparity
from recordings.simulator import raycast
from recordings.simulator.simulation import FrameTruth, Simulation
from stages.compiled.jit import typed_kernel
from stages.data import LEVEL_FRAME, Array, Cell, CellReason, Disparity, ElevationMap, NavigationMap, Transform

CELL_POINTS = 3  # along each side of a cell
SIGHT_TOLERANCE = 0.002  # m before its end that a line of sight may stop
MIN_HAZARD_ROCK = 0.2  # m, height above the ground around it
MAX_SAFE_SLOPE = float(np.radians(20))
MAX_ROCK_DISTANCE = 10.0  # m from base_link


def true_disparity(simulation: Simulation, stamp: int, truth: FrameTruth) -> Disparity:
    """fx * baseline / depth, px; NaN in the sky."""
    camera = simulation.camera
    pixels = np.where(np.isfinite(truth.depth), camera.fx * camera.baseline / truth.depth, np.nan)
    return exact_disparity(stamp, pixels.astype(np.float32), camera)


def truth_maps(simulation: Simulation, stamp: int, truth: FrameTruth) -> tuple[ElevationMap, NavigationMap]:
    """Elevation (top surface, rocks included) with the mask `visible`, and hazards, over the square around base_link.

    The elevation map also has the layers of `_map_layers`. A cell is a hazard if its centre lies on a rock at least
    0.2 m high or on ground steeper than 20 degrees. A cell is visible if a pixel that both cameras see hits it within
    the region.
    """
    terrain, half, step = simulation.terrain, simulation.map_half_width, simulation.map_resolution
    count = round(2 * half / step)
    middle = -half + (np.arange(count) + 0.5) * step
    x, y = np.meshgrid(middle, middle)
    world = truth.level(np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1))
    top, surface = raycast.tops_at(terrain.scene, world[:, 0], world[:, 1], float(terrain.scene.ceiling))
    elevation = (top - truth.level.translation[2]).reshape(x.shape).astype(np.float32)
    on_high_rock = np.append(terrain.rocks.height >= MIN_HAZARD_ROCK, False)[np.maximum(surface, raycast.GROUND)]
    hazard = on_high_rock | (terrain.slope(world[:, 0], world[:, 1]) > MAX_SAFE_SLOPE)
    cells = np.where(hazard, np.int8(Cell.HAZARD), np.int8(Cell.FREE)).reshape(x.shape)
    visible = visible_cells(simulation, truth, count)
    more = _map_layers(simulation, truth, x, y, elevation, visible, surface.reshape(x.shape))
    layers = {"elevation": elevation, "visible": visible, **more}
    on_slope = np.where(hazard, CellReason.SLOPE, CellReason.CLEAR)
    reason = np.where(on_high_rock, CellReason.STEP, on_slope).astype(np.uint8).reshape(x.shape)
    grid = step, (-half, -half), LEVEL_FRAME
    return ElevationMap(stamp, layers, *grid), NavigationMap(stamp, cells, reason, *grid)


def visible_cells(simulation: Simulation, truth: FrameTruth, count: int) -> Array:
    """(count, count) float32: 1 where a pixel that both cameras see hits the cell within the region, else 0."""
    mount = _camera_in_level(truth)
    a, b, known = _seen_within(simulation, truth)
    rows = slice(int(np.argmax(known.any(axis=1))), None)  # sky and far ground above them
    known, b, places = known[rows], b[rows], []
    depth = np.where(known, truth.depth[rows], 0.0)
    for axis in (1, 0):
        right, down, ahead = mount.rotation[axis]
        place = depth * (right * a + (down * b + ahead))
        place += mount.translation[axis] + simulation.map_half_width
        place /= simulation.map_resolution
        known &= (place >= 0) & (place < count)
        places.append(place)
    row, column = (place[known].astype(np.int64) for place in places)
    hits = np.bincount(row * count + column, minlength=count * count)
    return (hits > 0).astype(np.float32).reshape(count, count)


def rocks_in_level(simulation: Simulation, truth: FrameTruth) -> Array:
    """Rocks within 10 m of base_link, (N, 7) float32: x, y, z of the base in the level frame, diameter, height, m, and
    the two columns of `rocks_in_view`."""
    terrain, here = simulation.terrain, truth.level.translation
    near = here[:2] + (terrain.rocks.center - here[:2] + terrain.extent / 2) % terrain.extent - terrain.extent / 2
    points = truth.level.inverse()(np.column_stack([near, terrain.rocks.base]))
    seen = rocks_in_view(simulation, truth)
    table = np.column_stack([points, terrain.rocks.diameter, terrain.rocks.height, seen])
    return table[np.hypot(points[:, 0], points[:, 1]) <= MAX_ROCK_DISTANCE].astype(np.float32)


def rocks_in_view(simulation: Simulation, truth: FrameTruth) -> Array:
    """(N, 2) float32 of the tile's rocks: pixels that both cameras see within the region, and the share of the height
    that these span."""
    rocks = simulation.terrain.rocks
    a, b, seen = _seen_within(simulation, truth)
    row, col = np.nonzero(seen & (truth.surface >= 0))
    rock, depth = truth.surface[row, col], truth.depth[row, col]
    up = truth.base.after(truth.mounts[0]).rotation[2]
    height = depth * (up[0] * a[col] + up[1] * b[row, 0] + up[2])
    low, high = np.full(len(rocks), np.inf), np.full(len(rocks), -np.inf)
    np.minimum.at(low, rock, height)
    np.maximum.at(high, rock, height)
    pixels = np.bincount(rock, minlength=len(rocks))
    shown = np.where(pixels > 0, (high - low) / rocks.height, 0.0)
    return np.column_stack([pixels, np.minimum(shown, 1.0)]).astype(np.float32)


def _seen_within(simulation: Simulation, truth: FrameTruth) -> tuple[Array, Array, Array]:
    """The rays' slopes, across (W,) and down (H, 1), and which pixels (H, W) both cameras see within the region."""
    camera, mount = simulation.camera, _camera_in_level(truth)
    a = (np.arange(camera.width) - camera.cx) / camera.fx
    b = ((np.arange(camera.height) - camera.cy) / camera.fy)[:, None]
    both, slant = truth.seen == 255, np.sqrt(a**2 + b**2 + 1)
    within = both & (truth.depth <= simulation.region / slant)
    row, column = np.nonzero(both & ~within & (truth.depth <= 2 * simulation.region / slant))  # farther under a mast
    depth, (right, down, ahead) = truth.depth[row, column], mount.rotation[:2].T[:, :, None]
    place = depth * (right * a[column] + down * b[row, 0] + ahead) + mount.translation[:2, None]
    within[row, column] = np.hypot(*place) <= simulation.region
    return a, b, within


def _camera_in_level(truth: FrameTruth) -> Transform:
    """Level frame <- left camera."""
    return truth.level.inverse().after(truth.base.after(truth.mounts[0]))


def _map_layers(simulation: Simulation, truth: FrameTruth, x: Array, y: Array, top: Array, visible: Array,
                surface: Array) -> dict[str, Array]:  # fmt: skip
    """Further true layers over cells with centres x, y (rows, cols), m, in the frame's level frame.

    top: (rows, cols) elevation, m; visible: (rows, cols), 1 where a pixel of both cameras hits the cell; surface:
    (rows, cols) int, index of the rock seen from above at the centre, or the ground.

    Returns float32 (rows, cols): mean, m, of the surface over the cell, NaN where it is not visible; in_view, 1 where
    both cameras could see some of it within the region, else 0; rock, m, the height of the rock at the centre, 0 for
    the ground; slope, rad, of the bare ground over 1 m.
    """
    terrain, step = simulation.terrain, simulation.map_resolution
    near = np.hypot(x, y) <= simulation.region + step
    ahead = (visible > 0) | (near & _in_images(simulation, truth, x, y, top))
    row, col = np.nonzero(ahead)
    offset = ((np.arange(CELL_POINTS) + 0.5) / CELL_POINTS - 0.5) * step
    dx, dy = (part.ravel() for part in np.meshgrid(offset, offset))
    fine_x, fine_y = x[row, col, None] + dx, y[row, col, None] + dy
    world = truth.level(np.stack([fine_x.ravel(), fine_y.ravel(), np.zeros(fine_x.size)], axis=1))
    heights, _ = raycast.tops_at(terrain.scene, world[:, 0], world[:, 1], float(terrain.scene.ceiling))
    world[:, 2] = heights
    mean, in_view = np.full(x.shape, np.nan, np.float32), (visible > 0).astype(np.float32)
    mean[row, col] = (heights - truth.level.translation[2]).reshape(fine_x.shape).mean(axis=1)
    mean[visible == 0] = np.nan
    points = world.reshape(len(row), CELL_POINTS**2, 3)
    for number in range(CELL_POINTS**2):  # one point in sight is enough
        left = np.flatnonzero(in_view[row, col] == 0)
        in_view[row[left], col[left]] = in_sight(simulation, truth, points[left, number])
    height = np.append(terrain.rocks.height, 0.0)[np.maximum(surface, raycast.GROUND)]
    centre = truth.level(np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1))
    slope = terrain.slope(centre[:, 0], centre[:, 1], 1.0).reshape(x.shape)
    return {"mean": mean, "in_view": in_view, "rock": height.astype(np.float32), "slope": slope.astype(np.float32)}


def in_sight(simulation: Simulation, truth: FrameTruth, points: Array) -> Array:
    """Which points (N, 3) of the world, m, both cameras see within the region: (N,) bool."""
    eyes = [truth.base.after(mount) for mount in truth.mounts]
    aside = np.hypot(*truth.level.inverse()(points)[:, :2].T)
    slant = np.linalg.norm(points - eyes[0].translation, axis=1)
    seen: Array = np.fmin(aside, slant) <= simulation.region
    for eye in eyes:
        seen &= _within_image(simulation, (points - eye.translation) @ eye.rotation)
        asked = np.flatnonzero(seen)
        clear = np.zeros(len(asked), np.bool_)
        _clear_lines(simulation.terrain.scene, eye.translation, points[asked], clear)
        seen[asked] = clear
    return seen


def _in_images(simulation: Simulation, truth: FrameTruth, x: Array, y: Array, z: Array) -> Array:
    """Which points of the level frame, of any shape, lie within both images, with a margin of 20 px."""
    points = truth.level(np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1))
    inside = np.ones(len(points), bool)
    for mount in truth.mounts:
        eye = truth.base.after(mount)
        inside &= _within_image(simulation, (points - eye.translation) @ eye.rotation, 20.0)
    return inside.reshape(x.shape)


def _within_image(simulation: Simulation, points: Array, margin: float = 0.0) -> Array:
    """Which points (N, 3) of a camera's optical frame are in its image."""
    camera = simulation.camera
    depth = np.where(points[:, 2] > 0.05, points[:, 2], np.nan)
    u, v = points[:, 0] / depth * camera.fx + camera.cx, points[:, 1] / depth * camera.fy + camera.cy
    reach = 0.5 + margin
    return np.asarray((u >= -reach) & (u < camera.width - 1 + reach) & (v >= -reach) & (v < camera.height - 1 + reach))


@typed_kernel
def _clear_lines(scn: Any, eye: Any, points: Any, clear: Any) -> None:
    """Which points (N, 3) are not hidden from `eye`, into clear (N,) bool."""
    for k in range(points.shape[0]):
        dx, dy, dz = points[k, 0] - eye[0], points[k, 1] - eye[1], points[k, 2] - eye[2]
        end = 1.0 - SIGHT_TOLERANCE / np.sqrt(dx * dx + dy * dy + dz * dz)
        clear[k] = raycast.first_hit(scn, eye[0], eye[1], eye[2], dx, dy, dz, end)[1] == raycast.SKY
