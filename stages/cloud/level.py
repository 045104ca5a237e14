"""Level: turn a cloud upright with the inclinometer (paper section 4, "Digital Elevation Model").

The trick is to use no Euler angles. The tilt is the direction of up; carried into the camera it is the level frame's z
axis as seen from the camera, the horizontal part of the heading is its x axis, their cross product its y axis, and the
three stacked as rows are the rotation. No order of turns and no sign of an angle can go wrong.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flow.contracts import StageError
from stages.cloud.kernels.rigid import transform_points
from stages.data import LEVEL_FRAME, Array, Mount, PointCloud, Tilt, Transform
from stages.stage import Stage, parameter

# Below this horizontal share (6 degrees off the vertical) tilt noise decides where a heading points.
_LEAST_HORIZONTAL = 0.1


@dataclass(frozen=True)
class Level(Stage):
    """Carries a cloud from the camera into the gravity-aligned frame `level`.

    `tilt_sigma` is that of the tilt at the frame's time: of readings with a standard deviation s, 0.8 s where it lies
    between two of them, s / sqrt(n) where it is smoothed over n, as many before the frame as after it. Errors about the
    two axes are taken as independent, so at (x, y) a height has the variance tilt_sigma^2 (x^2 + y^2).
    """

    camera_height: float = parameter(
        1.0, "height of the left camera above the origin, where base_link is not known", unit="m", low=0.0
    )
    tilt_sigma: float = parameter(
        0.0042, "standard deviation of the tilt, as it comes, about each horizontal axis, for the map's common "
        "variance (0.24 degrees: 0.3 of a reading, less by interpolation between two)",
        unit="rad", low=0.0, high=0.5,
    )  # fmt: skip

    def __call__(self, cloud: PointCloud, tilt: Tilt, mount: Mount | None = None) -> PointCloud:
        """The cloud in frame `level`, with `sensor` telling where the camera is in it.

        Without `mount` the tilt must be given in the cloud's own frame: how an inclinometer sits is never guessed.
        """
        if cloud.sensor is not None:
            raise StageError(f"Level: the cloud is in frame '{cloud.frame_id}', not its camera's; level it only once")
        if not cloud.measured.any():
            raise StageError("Level: no measured point of the frame is left; nothing was matched within the region")
        if mount is None:
            if tilt.frame_id != cloud.frame_id:
                raise StageError(
                    f"Level: the tilt is in frame '{tilt.frame_id}', the cloud in '{cloud.frame_id}', and nothing says "
                    "how one sits in the other; connect the port 'mount'"
                )
            mount = Mount(tilt.stamp, np.eye(3))
        sensor = level_transform(tilt, mount, cloud.frame_id, self.camera_height)
        points = transform_points(cloud.points, sensor.rotation, sensor.translation)
        return replace(cloud, points=points, frame_id=LEVEL_FRAME, sensor=sensor, tilt_sigma=self.tilt_sigma)


def level_transform(tilt: Tilt, mount: Mount, camera_frame: str, camera_height: float = 1.0) -> Transform:
    """The left camera in the level frame: z up, x the rover's horizontal heading, y left.

    The heading is that of base_link's x axis and the origin base_link's, where `mount` knows base_link; else the
    camera's optical axis and the point `camera_height` metres below the left camera. Raises ValueError where the
    heading is so close to vertical that it points nowhere.
    """
    up = mount.camera_from_inclinometer @ tilt.up
    up = up / np.linalg.norm(up)
    forward, origin = _heading_and_origin(mount, up, camera_height)
    level = forward - (forward @ up) * up
    if not float(np.linalg.norm(level)) > _LEAST_HORIZONTAL:
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
