"""Where a levelled cloud lies in the frame of the rover's pose, and in which cells of the regional map.

Only heading and place are the pose's: the cloud knows by itself, from the inclinometer, which way is up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from flow.contracts import StageError
from stages.cloud.kernels.rigid import transform_points
from stages.data import LEVEL_FRAME, Array, ElevationMap, Mount, PointCloud, Pose, Transform
from stages.terrain.dem import Voxelise

# Beyond this the pose's frame does not have z up. An odometry that knows no tilt may differ by the slope of the ground.
_LARGEST_LEAN = np.radians(30.0)


@dataclass(frozen=True, eq=False)
class FrameGrid:
    """What one frame shows of the region.

    placed: frame `level` in the region's; terrain: the elevation map of the frame, whose cells are the region's and
    whose heights are in its frame; row, col: of its first cell in the region.
    """

    placed: Transform
    terrain: ElevationMap
    row: int
    col: int

    @cached_property
    def known(self) -> Array:
        """Cells that have a height, and whose error is known, (rows, cols) bool."""
        return np.isfinite(self.terrain.layers["elevation"]) & np.isfinite(self.terrain.layers["variance"])

    @cached_property
    def ceiling(self) -> Array:
        """What hidden cells lie below, (rows, cols) m, NaN where none is told to be hidden."""
        return self.terrain.layers.get("ceiling", np.full(self.terrain.shape, np.nan))

    def offsets(self, which: Array) -> tuple[Array, Array]:
        """x and y of the centres of the cells of a mask, (rows, cols) bool, from the rover, m."""
        rows, cols = np.nonzero(which)
        x, y = (
            (first + cells + 0.5) * self.terrain.resolution for first, cells in ((self.col, cols), (self.row, rows))
        )
        return x - self.placed.translation[0], y - self.placed.translation[1]


def placement(cloud: PointCloud, pose: Pose, mount: Mount | None = None) -> tuple[Transform, Array]:
    """Frame `level` of a levelled cloud in the pose's frame: upright, turned by the pose's heading; and up (3,), as the
    tilt tells, in the frame as it is.

    Pitch and roll of the pose are not used: which way is up, the inclinometer knows. Raises ValueError where nothing
    tells how the frame whose pose it is sits to the camera, or where the pose's frame does not have z up.
    """
    assert cloud.sensor is not None
    child = _child_from_camera(pose, cloud.sensor, mount)
    camera = pose.transform.rotation @ child.rotation
    turned = camera @ cloud.sensor.rotation.T
    lean = float(np.arccos(np.clip(turned[2, 2], -1.0, 1.0)))
    if lean > _LARGEST_LEAN:
        raise StageError(
            f"Fuse: z of the pose's frame '{pose.frame_id}' is {np.degrees(lean):.0f} degrees off the vertical of the "
            "tilt; give a pose in a frame whose z points up"
        )
    yaw = np.arctan2(turned[1, 0] - turned[0, 1], turned[0, 0] + turned[1, 1])
    rotation = Rotation.from_euler("z", yaw).as_matrix()
    origin = cloud.sensor(child.inverse().translation)  # of the frame whose pose it is, in level
    return Transform(pose.frame_id, LEVEL_FRAME, rotation, pose.position - rotation @ origin), turned[:, 2]


def _child_from_camera(pose: Pose, sensor: Transform, mount: Mount | None) -> Transform:
    """The camera in the frame whose pose is given."""
    mount = mount or Mount(0, np.eye(3))
    seat = mount.camera_in(pose.child_frame_id, sensor.child)
    if seat is None:
        raise StageError(
            f"Fuse: the pose is that of '{pose.child_frame_id}', and nothing tells how the camera '{sensor.child}' "
            "sits on it; record its static transform, or set base_frame of the source"
        )
    return seat


def sight_of(cloud: PointCloud, placed: Transform, resolution: float, region: float) -> FrameGrid:
    """What the measured points of a cloud show of the region's cells.

    cloud: in frame `level`, which is `placed` upright in the region's frame; resolution, region: of `Voxelise`, m.
    """
    cloud = cloud.only(cloud.measured)
    cell = np.floor(placed.translation[:2] / resolution).astype(int)
    rest = replace(placed, translation=np.append(placed.translation[:2] - cell * resolution, 0.0))
    points = transform_points(cloud.points, rest.rotation, rest.translation)
    sensor = None if cloud.sensor is None else replace(rest.after(cloud.sensor), parent=LEVEL_FRAME)
    terrain = Voxelise(resolution=resolution, max_range=region)(replace(cloud, points=points, sensor=sensor))
    col, row = (int(number) - extent // 2 for number, extent in zip(cell, terrain.shape[::-1], strict=True))
    heights = [name for name in ("elevation", "minimum", "maximum", "ceiling") if name in terrain.layers]
    lifted = {name: terrain.layers[name] + np.float32(placed.translation[2]) for name in heights}
    origin = (col * resolution, row * resolution)
    terrain = replace(terrain, layers={**terrain.layers, **lifted}, origin=origin, frame_id=placed.parent)
    return FrameGrid(placed, terrain, row, col)


def raised(placed: Transform, plane: Array) -> Transform:
    """A placement with a plane (height, slopes) added: a rise, and the small rotation that makes the slopes."""
    turn = Rotation.from_rotvec([plane[2], -plane[1], 0.0]).as_matrix()
    return replace(placed, rotation=turn @ placed.rotation, translation=placed.translation + np.array([0, 0, plane[0]]))
