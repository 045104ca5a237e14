"""Level: turn a cloud upright with the inclinometer (paper section 4, "Digital Elevation Model").

No Euler angles are used. The tilt is the direction of up. In the camera's frame it is the level frame's z axis, the
horizontal part of the heading is its x axis, and their cross product its y axis. Stacked as rows they are the rotation,
so no order of rotations and no sign of an angle can be wrong.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flow.contracts import StageError
from stages.cloud.kernels.rigid import transform_points
from stages.data import LEVEL_FRAME, Array, Mount, PointCloud, Tilt, Transform
from stages.stage import Stage, check_types, parameter

_MIN_HORIZONTAL = 0.1  # of a unit heading, 6 degrees off the vertical; below it tilt noise decides the direction


@dataclass(frozen=True)
class Level(Stage):
    """Transforms a cloud from the camera's frame to the gravity-aligned frame `level`.

    Examples
    --------
    >>> cloud = PointCloud(0, np.float32([[0, 0, 3]]), np.zeros((1, 3), np.uint8), np.zeros(1, np.float32),
    ...                    np.zeros(1, np.int32), "camera")
    >>> level = Level(camera_height=1.5)(cloud, Tilt(0, [0.0, -1.0, 0.0], "camera"))
    >>> level.frame_id, level.points.tolist()
    ('level', [[3.0, 0.0, 1.5]])
    """

    camera_height: float = parameter(
        1.0, "height of the left camera above the origin, if base_link is not known", unit="m", low=0.0
    )
    tilt_sigma: float = parameter(
        0.0042, "standard deviation of a tilt of unknown sigma, about each horizontal axis, for the map's common "
        "variance (0.24 degrees: readings of 0.3 degrees, interpolated)",
        unit="rad", low=0.0, high=0.5,
    )  # fmt: skip

    def __call__(self, cloud: PointCloud, tilt: Tilt, mount: Mount | None = None) -> PointCloud:
        """The cloud in frame `level`; its `sensor` is the camera in that frame.

        Without `mount` the tilt must be in the cloud's own frame, because the inclinometer's mounting is never guessed.
        """
        check_types(self, cloud=cloud, tilt=tilt, mount=mount)
        if cloud.sensor is not None:
            raise StageError(f"Level: the cloud is in frame '{cloud.frame_id}', not its camera's; level it only once")
        if not cloud.measured.any():
            raise StageError("Level: the frame has no measured point within range")
        if mount is None:
            if tilt.frame_id != cloud.frame_id:
                raise StageError(
                    f"Level: the tilt is in frame '{tilt.frame_id}', the cloud in '{cloud.frame_id}', and the rotation "
                    "between them is unknown; connect the port 'mount'"
                )
            mount = Mount(tilt.stamp, np.eye(3))
        sensor = level_transform(tilt, mount, cloud.frame_id, self.camera_height)
        points = transform_points(cloud.points, sensor.rotation, sensor.translation)
        sigma = self.tilt_sigma if tilt.sigma is None else tilt.sigma
        return replace(cloud, points=points, frame_id=LEVEL_FRAME, sensor=sensor, tilt_sigma=sigma)


def level_transform(tilt: Tilt, mount: Mount, camera_frame: str, camera_height: float = 1.0) -> Transform:
    """The left camera in the level frame: z up, x the rover's horizontal heading, y left.

    If `mount` contains base_link, x is the heading of its x axis and the origin is its origin. Otherwise x is the
    heading of the optical axis, and the origin is `camera_height` metres below the left camera. Raises StageError if
    the heading is nearly vertical.
    """
    up = mount.camera_from_inclinometer @ tilt.up
    up = up / np.linalg.norm(up)
    forward, origin = _heading_and_origin(mount, up, camera_height)
    level = forward - (forward @ up) * up
    if not float(np.linalg.norm(level)) > _MIN_HORIZONTAL:
        raise StageError(
            "Level: the heading is nearly vertical, so the level frame has no x axis; check the tilt's sign and the "
            "inclinometer's mount, or give base_link's transform if the camera looks straight down"
        )
    x = level / np.linalg.norm(level)
    rotation = np.stack([x, np.cross(up, x), up])
    return Transform(LEVEL_FRAME, camera_frame, rotation, -rotation @ origin)


def _heading_and_origin(mount: Mount, up: Array, camera_height: float) -> tuple[Array, Array]:
    """The rover's forward direction and the level frame's origin, both in the camera's frame."""
    base = mount.base_from_camera
    if base is None:
        return np.array([0.0, 0.0, 1.0]), -camera_height * up
    return base.rotation[0], base.inverse().translation
