"""How the camera sits on the rover: relative to its base frame and to its inclinometer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from recordings.errors import LogError
from recordings.source.calibration import Camera
from recordings.source.transforms import TransformTree
from stages.data import Array, Mount, Pose
from stages.data.rotations import matrix_of

ODOMETRY_FRAME = "odom"  # of poses whose frame has no name
STATIC_STAMP = 0  # ns; a mount holds for the whole log, whose frames may have stamps of another clock


def mount_of(
    camera: Camera,
    inclinometer: str,
    base: str,
    tree: TransformTree,
    given: Sequence[float] | None,
    stamp: int = STATIC_STAMP,
) -> Mount:
    """The mount of the left camera.

    inclinometer, base: their frames; given: the user's quaternion xyzw from inclinometer to left rectified camera
    coordinates. Raises LogError where that rotation is unknown.
    """
    to_base = tree.between(base, camera.frame_id)
    base_from_camera = to_base.after(camera.image) if to_base is not None else None
    return Mount(stamp, _camera_from_inclinometer(camera, inclinometer, tree, given), base_from_camera)


def pose_of_base(pose: Pose, camera: Camera, base: str, tree: TransformTree) -> Pose:
    """The pose of the frame `base`, or of the camera's rectified image where nothing joins the camera and `base`.

    A pose of the camera's own frame becomes that of its rectified image. A pose of a frame that no static transform
    joins to them is returned as it is. A frame without a name becomes `odom`, because no transform can have it.
    """
    pose = pose if pose.frame_id else replace(pose, frame_id=ODOMETRY_FRAME)
    of = pose.child_frame_id
    if of in (base, camera.image_frame):
        return pose
    part = None if of == camera.frame_id else tree.between(of, base)
    if part is None and (to_camera := tree.between(of, camera.frame_id)) is not None:
        part = to_camera.after(camera.image)
    return pose if part is None else pose.of(part)


def _camera_from_inclinometer(
    camera: Camera, inclinometer: str, tree: TransformTree, given: Sequence[float] | None
) -> Array:
    if given is not None:
        return matrix_of(given)
    transform = tree.between(camera.frame_id, inclinometer)
    if transform is None:
        raise LogError(
            f"no static transform joins the camera ({_quoted(camera.frame_id)}) and the inclinometer "
            f"({_quoted(inclinometer)}); "
            "record /tf_static (and /tf if the camera moves on the rover, or set 'joints' of the source), or set "
            "'camera_from_inclinometer' (quaternion x, y, z, w) of the source"
        )
    return np.asarray(camera.model.r @ transform.rotation)


def _quoted(frame: str) -> str:
    return f"'{frame}'" if frame else "whose frame_id is empty"
