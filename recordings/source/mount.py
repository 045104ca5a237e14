"""How the camera sits on the rover."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from recordings.errors import LogError
from recordings.source.calibration import Camera
from recordings.source.transforms import TransformTree
from stages.data import Array, Mount, Pose

EVER = 0  # ns, the stamp of what holds throughout: frames may be before the log's first message, or of another clock


def mounted(
    camera: Camera, inclinometer: str, base: str, frames: TransformTree, given: Sequence[float] | None
) -> Mount:
    """How the left camera sits on the rover.

    inclinometer, base: their frames; given: quaternion xyzw that turns inclinometer into left rectified camera
    coordinates, where the user gave it. Raises LogError where nothing tells that rotation.
    """
    based = frames.between(base, camera.frame_id)
    base_from_camera = based.after(camera.image) if based is not None else None
    return Mount(EVER, _camera_from_inclinometer(camera, inclinometer, frames, given), base_from_camera)


def rovers(pose: Pose, camera: Camera, base: str, frames: TransformTree) -> Pose:
    """A pose as that of the frame `base`, or where the camera does not sit on that, of the camera's rectified image; as
    it is where no static transform tells how they sit on the frame whose pose it is."""
    told = pose.child_frame_id
    if told in (base, camera.image_frame):
        return pose
    if told != camera.frame_id and frames.between(base, camera.frame_id) is not None:
        part = frames.between(told, base)
    else:
        on_camera = frames.between(told, camera.frame_id)
        part = None if on_camera is None else on_camera.after(camera.image)
    return pose if part is None else pose.of(part)


def _camera_from_inclinometer(
    camera: Camera, inclinometer: str, frames: TransformTree, given: Sequence[float] | None
) -> Array:
    if given is not None:
        return np.asarray(Rotation.from_quat(given).as_matrix())
    placed = frames.between(camera.frame_id, inclinometer)
    if placed is None:
        raise LogError(
            f"no static transform joins the camera ({_frame(camera.frame_id)}) and the inclinometer "
            f"({_frame(inclinometer)}); "
            "record /tf_static, or set 'camera_from_inclinometer' (quaternion x, y, z, w) of the source"
        )
    return np.asarray(camera.model.r @ placed.rotation)


def _frame(name: str) -> str:
    return f"'{name}'" if name else "whose frame_id is empty"
