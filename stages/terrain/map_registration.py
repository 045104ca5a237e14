"""Registration of a levelled cloud in the frame of the rover's pose, and in the cells of the regional map.

Only heading and position come from the pose. Up comes from the inclinometer, because the cloud is levelled already.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from flow.contracts import StageError
from stages.cloud.kernels.rigid import transform_points
from stages.data import LEVEL_FRAME, Array, ElevationMap, Mount, PointCloud, Pose, Transform
from stages.data.arrays import Span, spanned
from stages.data.rotations import quaternion_of, turn_about_z, turn_by
from stages.stage import Stage
from stages.terrain.dem import Voxelise

# Between z of the pose's frame and up. Odometry without an inclinometer may differ by the slope of the ground.
_MAX_LEAN = np.radians(30.0)


HEIGHTS = {"elevation", "minimum", "maximum", "ceiling"}  # layers, m


@dataclass(frozen=True, eq=False)
class FrameGrid:
    """The cells of the regional map that one frame shows.

    level: frame `level` in the map's frame; terrain: the frame's elevation map, on the map's cells and in its frame;
    row, col: of the first cell in the map.
    """

    level: Transform
    terrain: ElevationMap
    row: int
    col: int

    @cached_property
    def known(self) -> Array:
        """Cells with a height and a variance, (rows, cols) bool."""
        return np.isfinite(self.terrain.layers["elevation"]) & np.isfinite(self.terrain.layers["variance"])

    @cached_property
    def ceiling(self) -> Array:
        """Height, m, below which occluded cells lie, (rows, cols), NaN elsewhere."""
        return self.terrain.layers.get("ceiling", np.full(self.terrain.shape, np.nan))

    def offsets(self, which: Array) -> tuple[Array, Array]:
        """x and y, m from the rover, of the centres of the cells of a mask, (rows, cols) bool."""
        rows, cols = np.divmod(np.flatnonzero(which), which.shape[1])
        firsts = ((self.col, cols), (self.row, rows))
        x, y = ((first + cells + 0.5) * self.terrain.resolution for first, cells in firsts)
        return x - self.level.translation[0], y - self.level.translation[1]


def register(stage: Stage, cloud: PointCloud, pose: Pose, mount: Mount | None = None) -> tuple[Transform, Array]:
    """Frame `level` of a levelled cloud in the pose's frame, upright with the pose's heading; and up (3,) by the tilt.

    Roll and pitch of the pose are not used. Raises StageError if the transform from the pose's child frame to the
    camera is unknown, or if z of the pose's frame is not up.
    """
    assert cloud.sensor is not None
    child = _child_from_camera(stage, pose, cloud.sensor, mount)
    camera = pose.transform.rotation @ child.rotation
    turned = camera @ cloud.sensor.rotation.T
    lean = float(np.arccos(np.clip(turned[2, 2], -1.0, 1.0)))
    if lean > _MAX_LEAN:
        raise StageError(
            f"{type(stage).__name__}: z of the pose's frame '{pose.frame_id}' is {np.degrees(lean):.0f} degrees off "
            "the vertical of the tilt; check the tilt, give a pose in a frame whose z points up, or set "
            "source.odometry to visual"
        )
    yaw = np.arctan2(turned[1, 0] - turned[0, 1], turned[0, 0] + turned[1, 1])
    rotation = turn_about_z(yaw)
    origin = cloud.sensor(child.inverse().translation)  # of the pose's child frame, in level
    return Transform(pose.frame_id, LEVEL_FRAME, rotation, pose.position - rotation @ origin), turned[:, 2]


def _child_from_camera(stage: Stage, pose: Pose, sensor: Transform, mount: Mount | None) -> Transform:
    """The camera in the pose's child frame."""
    camera = (mount or Mount(0, np.eye(3))).camera_in(pose.child_frame_id, sensor.child)
    if camera is None:
        raise StageError(
            f"{type(stage).__name__}: the pose is of '{pose.child_frame_id}', and no transform links it to the camera "
            f"'{sensor.child}'; record its static transform, or set base_frame of the source"
        )
    return camera


def frame_grid(cloud: PointCloud, level: Transform, resolution: float, max_range: float) -> FrameGrid:
    """The measured points of a cloud in frame `level`, on the cells of the regional map.

    The cloud is shifted by less than a cell before it is binned, so that nothing is resampled.
    """
    cloud = cloud.only(cloud.measured)
    cell = np.floor(level.translation[:2] / resolution).astype(int)
    rest = replace(level, translation=np.append(level.translation[:2] - cell * resolution, 0.0))
    points = transform_points(cloud.points, rest.rotation, rest.translation)
    sensor = None if cloud.sensor is None else replace(rest.after(cloud.sensor), parent=LEVEL_FRAME)
    binning = Voxelise(resolution=resolution, max_range=max_range)
    grid, layers = binning.in_view(replace(cloud, points=points, sensor=sensor))
    rows, cols = _seen(layers)
    half = binning.whole.shape[0] // 2
    row, col = (int(cell[1 - axis]) - half + grid.first[axis] + (rows, cols)[axis].start for axis in (0, 1))
    layers = {name: layer[rows, cols] for name, layer in layers.items()}
    for name in HEIGHTS & layers.keys():
        layers[name] = layers[name] + np.float32(level.translation[2])
    terrain = ElevationMap(cloud.stamp, layers, resolution, (col * resolution, row * resolution), level.parent)
    return FrameGrid(level, terrain, row, col)


def _seen(layers: Mapping[str, Array]) -> Span:
    """Rows and columns of the cells with a height or a ceiling and of their neighbours."""
    seen = np.isfinite(layers["elevation"])
    if "ceiling" in layers:
        seen |= np.isfinite(layers["ceiling"])
    return spanned(seen, 1)


def with_plane(level: Transform, plane: Array) -> Transform:
    """The transform of frame `level` with a plane (height, slopes) added: a rise and a small rotation."""
    rotation = turn_by([plane[2], -plane[1], 0.0])
    translation = level.translation + np.array([0, 0, plane[0]])
    return replace(level, rotation=rotation @ level.rotation, translation=translation)


def plane_between(level: Transform, after: Transform) -> Array:
    """The plane (3,) that `with_plane` added to frame `level`."""
    turn = quaternion_of(after.rotation @ level.rotation.T)  # small
    return np.array([after.translation[2] - level.translation[2], -2 * turn[1], 2 * turn[0]])
