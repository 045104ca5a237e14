"""The messages of a simulated log: what a rover would record, and the exact truth under /truth.

Disparity and occlusion come per left pixel from the rays that made the images; elevation and hazards from looking
straight down on the cell centres of the frame's own level frame, the frame a reader would build from the true tilt.
Each function returns (log time, topic, message) triples for one moment.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from recordings import ros2
from recordings.rig import pinhole
from recordings.ros2_types import make
from recordings.simulator import ground_truth, raycast, traverse
from stages.data import (
    LEVEL_FRAME,
    Array,
    Cell,
    Disparity,
    ElevationMap,
    NavigationMap,
    Pose,
    Reason,
    Source,
    Transform,
)

if TYPE_CHECKING:
    from recordings.simulator.simulation import FrameTruth, Simulation

Logged = tuple[int, str, Any]

HAZARD_ROCK = 0.2  # m, height above the ground around it
HAZARD_SLOPE = float(np.radians(20))
ROCKS_WITHIN = 10.0  # m of base_link
ROCK_FIELDS = ("x", "y", "z", "diameter", "height", "pixels", "shown")


def static_transforms(simulation: Simulation, log_time: int) -> list[Logged]:
    """/tf_static: the mounts of cameras and inclinometer."""
    return [(log_time, "/tf_static", ros2.transform_message((mount, log_time) for mount in simulation.mounts))]


def inclinometer(simulation: Simulation, number: int, stamp: int, log_time: int) -> list[Logged]:
    """/imu/inclinometer: roll and pitch with noise; the heading is not known and its variance says so."""
    rng = np.random.default_rng([simulation.seed, 4, number])
    reading = traverse.inclinometer_reading(
        simulation.base_at(stamp), simulation.mounts[2], simulation.tilt_noise, rng
    )  # fmt: skip
    variance = max(simulation.tilt_noise, 1e-6) ** 2
    message = ros2.imu(stamp, traverse.INCLINOMETER_FRAME, reading, np.diag([variance, variance, np.pi**2 / 3]))
    return [(log_time, "/imu/inclinometer", message)]


def odometry(simulation: Simulation, number: int, stamp: int, log_time: int) -> list[Logged]:
    """/odometry and /tf: dead reckoning since the first message."""
    pose = simulation.odometry[number]
    rotation = Rotation.from_quat(pose.quaternion).as_matrix()
    moved = Transform(pose.frame_id, pose.child_frame_id, rotation, pose.position)
    return [(log_time, "/odometry", ros2.odometry(pose)), (log_time, "/tf", ros2.transform_message([(moved, stamp)]))]


def frame(simulation: Simulation, index: int, log_time: int) -> list[Logged]:
    """Images, calibration and truth of one frame."""
    stamp, truth = simulation.stamp(index), simulation.frame(index)
    messages = {**_camera_messages(simulation, stamp, truth), **_truth_messages(simulation, stamp, truth)}
    return [(log_time, topic, message) for topic, message in messages.items()]


def _camera_messages(simulation: Simulation, stamp: int, truth: FrameTruth) -> dict[str, Any]:
    messages = {}
    name = "image_rect_color" if simulation.color else "image_rect"
    sides = (("left", traverse.LEFT_FRAME), ("right", traverse.RIGHT_FRAME))
    for (side, frame_id), picture in zip(sides, truth.images, strict=True):
        model = pinhole(simulation.camera, side)
        messages[f"/stereo/{side}/camera_info"] = ros2.camera_info(stamp, frame_id, model)
        messages[f"/stereo/{side}/{name}"] = ros2.image(stamp, frame_id, picture)
    return messages


def _truth_messages(simulation: Simulation, stamp: int, truth: FrameTruth) -> dict[str, Any]:
    elevation, hazards = truth_maps(simulation, stamp, truth)
    return {
        "/truth/disparity": ros2.disparity_image(true_disparity(simulation, stamp, truth)),
        "/truth/occlusion": ros2.image(stamp, traverse.LEFT_FRAME, truth.seen),
        "/truth/elevation_map": ros2.grid_map(elevation),
        "/truth/navigation_map": ros2.occupancy_grid(hazards),
        "/truth/rocks": _rocks_message(simulation, stamp, truth),
        "/truth/tilt": _tilt_message(stamp, truth),
        "/truth/pose": ros2.odometry(_true_pose(stamp, truth)),
    }


def true_disparity(simulation: Simulation, stamp: int, truth: FrameTruth) -> Disparity:
    """fx * baseline / depth, px; NaN in the sky."""
    camera = simulation.camera
    pixels = np.where(np.isfinite(truth.depth), camera.fx * camera.baseline / truth.depth, np.nan).astype(np.float32)
    known = np.isfinite(pixels)
    source = np.where(known, np.uint8(Source.MEASURED), np.uint8(Source.UNKNOWN))
    return Disparity(stamp, pixels, source, known.astype(np.float32), camera=camera)


def truth_maps(simulation: Simulation, stamp: int, truth: FrameTruth) -> tuple[ElevationMap, NavigationMap]:
    """Elevation (top surface, rocks included) with the mask `visible`, and hazards, over the square about base_link.

    The elevation map has the layers of `ground_truth.map_layers` besides. A cell is a hazard if its centre lies on a
    rock at least 0.2 m high or on ground steeper than 20 degrees. A cell is visible if a pixel that both cameras see
    hits it within the region.
    """
    terrain, half, step = simulation.terrain, simulation.map_half_width, simulation.map_resolution
    count = round(2 * half / step)
    middle = -half + (np.arange(count) + 0.5) * step
    x, y = np.meshgrid(middle, middle)
    world = truth.level(np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1))
    top, surface = raycast.tops_at(terrain.scene, world[:, 0], world[:, 1], float(terrain.scene.ceiling))
    elevation = (top - truth.level.translation[2]).reshape(x.shape).astype(np.float32)
    on_high_rock = np.append(terrain.rocks.height >= HAZARD_ROCK, False)[np.maximum(surface, raycast.GROUND)]
    hazard = on_high_rock | (terrain.slope(world[:, 0], world[:, 1]) > HAZARD_SLOPE)
    cells = np.where(hazard, np.int8(Cell.HAZARD), np.int8(Cell.FREE)).reshape(x.shape)
    visible = visible_cells(simulation, truth, count)
    more = ground_truth.map_layers(simulation, truth, x, y, elevation, visible, surface.reshape(x.shape))
    layers = {"elevation": elevation, "visible": visible, **more}
    reason = np.where(on_high_rock, Reason.STEP, np.where(hazard, Reason.SLOPE, Reason.CLEAR)).astype(np.uint8)
    return (
        ElevationMap(stamp, layers, step, (-half, -half), LEVEL_FRAME),
        NavigationMap(stamp, cells, reason.reshape(x.shape), step, (-half, -half), LEVEL_FRAME),
    )


def visible_cells(simulation: Simulation, truth: FrameTruth, count: int) -> Array:
    """(count, count) float32: 1 where a pixel that both cameras see hits the cell within the region, else 0."""
    camera, shape = simulation.camera, truth.depth.shape
    mount = truth.level.inverse().after(truth.base.after(simulation.mounts[0]))
    a, b = (np.arange(shape[1]) - camera.cx) / camera.fx, ((np.arange(shape[0]) - camera.cy) / camera.fy)[:, None]
    known = (truth.seen == 255) & (truth.depth <= simulation.region / np.sqrt(a**2 + b**2 + 1))
    rows = slice(int(known.any(axis=1).argmax()), None)  # sky and far ground above them
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
    the two columns of `ground_truth.rocks_in_view`."""
    terrain, here = simulation.terrain, truth.level.translation
    near = here[:2] + (terrain.rocks.center - here[:2] + terrain.extent / 2) % terrain.extent - terrain.extent / 2
    points = truth.level.inverse()(np.column_stack([near, terrain.rocks.base]))
    seen = ground_truth.rocks_in_view(simulation, truth)
    table = np.column_stack([points, terrain.rocks.diameter, terrain.rocks.height, seen])
    return table[np.hypot(points[:, 0], points[:, 1]) <= ROCKS_WITHIN].astype(np.float32)


def _rocks_message(simulation: Simulation, stamp: int, truth: FrameTruth) -> Any:
    table = rocks_in_level(simulation, truth)
    fields = [
        make("sensor_msgs/msg/PointField", name=name, offset=4 * place, datatype=ros2.FLOAT32, count=1)
        for place, name in enumerate(ROCK_FIELDS)
    ]
    return make(
        "sensor_msgs/msg/PointCloud2", header=ros2.header(stamp, LEVEL_FRAME), height=1, width=len(table),
        fields=fields, is_bigendian=False, point_step=4 * len(ROCK_FIELDS), row_step=4 * table.size,
        data=table.view(np.uint8).reshape(-1), is_dense=True,
    )  # fmt: skip


def _true_pose(stamp: int, truth: FrameTruth) -> Pose:
    quaternion = Rotation.from_matrix(truth.base.rotation).as_quat(canonical=True)
    return Pose(stamp, truth.base.translation, quaternion, truth.base.parent, truth.base.child)


def _tilt_message(stamp: int, truth: FrameTruth) -> Any:
    """geometry_msgs/QuaternionStamped: level <- base_link, in the header of base_link."""
    rotation = Rotation.from_matrix(truth.level.rotation.T @ truth.base.rotation)
    x, y, z, w = (float(value) for value in rotation.as_quat(canonical=True))
    turn = make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
    return make("geometry_msgs/msg/QuaternionStamped", header=ros2.header(stamp, "base_link"), quaternion=turn)
