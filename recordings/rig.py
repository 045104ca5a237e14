"""How the rover is built, from its log: static transforms, the calibrated pair, and how the camera sits on the rover.

Rectified coordinates are what a camera's own turn into by its rectifying rotation R (CameraInfo); the transforms of a
log speak of the camera's own frame, so R is applied where they meet the rectified image.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from recordings.decode import camera_model, transform_of
from recordings.discovery import looks_rectified
from recordings.errors import LogError
from stages.data import Array, CameraModel, Mount, Transform


@dataclass
class Frames:
    """The static transforms of a log, as a graph in which any two connected frames have a transform."""

    edges: dict[str, dict[str, Transform]] = field(default_factory=dict)
    given: set[tuple[str, str]] = field(default_factory=set)

    def add(self, message: Any) -> None:
        """Add the transforms of a tf2_msgs/TFMessage; a later one of the same frames replaces an earlier."""
        for item in message.transforms:
            transform = transform_of(item)
            self.given.add((transform.parent, transform.child))
            self.edges.setdefault(transform.parent, {})[transform.child] = transform
            self.edges.setdefault(transform.child, {})[transform.parent] = transform.inverse()

    def between(self, parent: str, child: str) -> Transform | None:
        """The transform from `child` to `parent`, along the fewest steps; None where nothing connects them."""
        reached = {parent: Transform(parent, parent, np.eye(3), np.zeros(3))}
        queue = deque([parent])
        while queue and child not in reached:
            frame = queue.popleft()
            for name, step in self.edges.get(frame, {}).items():
                if name not in reached:
                    reached[name] = reached[frame].after(step)
                    queue.append(name)
        return reached.get(child)

    def listed(self) -> list[str]:
        """Each transform of the log as "parent <- child", sorted."""
        return sorted(f"{parent} <- {child}" for parent, child in self.given)


@dataclass(frozen=True)
class Camera:
    """One camera: its calibration, whether its images are rectified, its frame."""

    model: CameraModel
    rectified: bool
    frame_id: str


def calibrated_pair(left: Any, right: Any, topics: tuple[str, str], frames: Frames) -> tuple[Camera, Camera]:
    """The two cameras of a stereo pair.

    left, right: their CameraInfo; topics: of their images. The baseline is that of the projection matrices, or where
    these have none (two single calibrations), that of the static transform between the cameras. Raises LogError where
    the log does not tell it.
    """
    models = [_checked(info, topic) for info, topic in zip((left, right), topics, strict=True)]
    rectified = [looks_rectified(t) or is_ideal(model) for t, model in zip(topics, models, strict=True)]
    if rectified[0] != rectified[1]:
        raise LogError(f"of {topics[0]} and {topics[1]} only one is rectified; set 'left' and 'right' to two alike")
    names = [info.header.frame_id.lstrip("/") for info in (left, right)]
    if models[0].p[0, 3] == 0 and models[1].p[0, 3] == 0:
        placed = frames.between(names[0], names[1])
        if placed is None or not np.any(placed.translation):
            raise LogError(
                "the log does not tell the baseline: P[0,3] of the right CameraInfo is 0 and no static transform "
                f"joins '{names[0]}' and '{names[1]}'; record the stereo calibration"
            )
        models = _joined(models[0], models[1], placed, rectified[0])
    baseline = models[0].p[0, 3] / models[0].p[0, 0] - models[1].p[0, 3] / models[1].p[0, 0]
    if not baseline > 0:
        raise LogError(
            f"the baseline is {baseline:.4g} m, so {topics[0]} is the right camera: exchange 'left' and 'right' "
            "of the source"
        )
    one, other = (Camera(m, r, n) for m, r, n in zip(models, rectified, names, strict=True))
    return one, other


def is_ideal(model: CameraModel) -> bool:
    """Whether raw and rectified image are the same: no distortion, no rotation, K = P."""
    return not np.any(model.d) and np.allclose(model.r, np.eye(3)) and np.allclose(model.k, model.p[:, :3])


def _checked(info: Any, topic: str) -> CameraModel:
    """The calibration; where a single camera left R or P out (zeros), those of a camera that needs no rectification."""
    if info.k[0] <= 0 and info.p[0] <= 0:
        raise LogError(f"the camera of {topic} is not calibrated (K and P of its CameraInfo are 0); calibrate it")
    model = camera_model(info)
    if not np.any(model.r):
        model = replace(model, r=np.eye(3))
    if not np.any(model.p):
        model = replace(model, p=np.hstack([model.k, np.zeros((3, 1))]))
    return model


def _joined(left: CameraModel, right: CameraModel, placed: Transform, rectified: bool) -> list[CameraModel]:
    """The pair with the baseline that a transform (right camera in the left's frame) tells."""
    if rectified:
        baseline = float(np.copysign(np.linalg.norm(placed.translation), placed.translation[0]))
        projection = right.p.copy()
        projection[0, 3] = -projection[0, 0] * baseline
        return [left, replace(right, p=projection)]
    inverse = placed.inverse()
    moved = inverse.translation.reshape(3, 1)
    size = (left.width, left.height)
    if left.model == "equidistant":
        made: Any = cv2.fisheye.stereoRectify(
            left.k, left.d, right.k, right.d, size, inverse.rotation, moved, cv2.CALIB_ZERO_DISPARITY
        )
    else:
        made = cv2.stereoRectify(
            left.k, left.d, right.k, right.d, size, inverse.rotation, moved,
            flags=cv2.CALIB_ZERO_DISPARITY, alpha=0,
        )  # fmt: skip
    return [replace(left, r=made[0], p=made[2]), replace(right, r=made[1], p=made[3])]


def mounted(
    stamp: int, camera: Camera, inclinometer: str, base: str, frames: Frames, given: Iterable[float] | None
) -> Mount:
    """How the left camera sits on the rover.

    inclinometer, base: their frames; given: quaternion xyzw that turns inclinometer into left rectified camera
    coordinates, where the user gave it. Raises LogError where nothing tells that rotation.
    """
    based = frames.between(base, camera.frame_id)
    rectified = Transform(camera.frame_id, camera.frame_id, camera.model.r.T, np.zeros(3))
    base_from_camera = based.after(rectified) if based is not None else None
    return Mount(stamp, _camera_from_inclinometer(camera, inclinometer, frames, given), base_from_camera)


def _camera_from_inclinometer(
    camera: Camera, inclinometer: str, frames: Frames, given: Iterable[float] | None
) -> Array:
    if given is not None:
        x, y, z, w = given
        values = np.array([x, y, z, w]) / np.linalg.norm([x, y, z, w])
        return np.asarray(Rotation.from_quat(values).as_matrix())
    placed = frames.between(camera.frame_id, inclinometer)
    if placed is None:
        raise LogError(
            f"no static transform joins the camera ('{camera.frame_id}') and the inclinometer ('{inclinometer}'); "
            "record /tf_static, or set 'camera_from_inclinometer' (quaternion x, y, z, w) of the source"
        )
    return np.asarray(camera.model.r @ placed.rotation)
