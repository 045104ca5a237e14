"""How the rover is built, from its log: static transforms, the calibrated pair, and how the camera sits on the rover.

Rectified coordinates are what a camera's own turn into by its rectifying rotation R (CameraInfo); the transforms of a
log speak of the camera's own frame, so R is applied where they meet the rectified image, whose frame has another name.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from recordings.errors import LogError
from recordings.source.discovery import looks_rectified
from recordings.source.transforms import TransformTree
from stages.data import CameraModel, StereoCamera, Transform

_SAME = 1e-6  # m and matrix elements; two transforms of the same frames that differ by more contradict each other
_PARALLEL = 1e-3  # rad; cameras turned against each other by less need no rectification: a pixel at 1000 px
_BESIDE = 0.01  # of the baseline; and so for cameras that are shifted against each other by less in y and z
_AGREEING = 0.05  # of a baseline; what tells it twice tells the same where it differs by less
SHORTEST, LONGEST = 1.0, 1e6  # px, focal lengths
_SHRUNK = 0.1  # of the focal length; what rectification makes smaller than that is no image


@dataclass(frozen=True)
class Camera:
    """One camera: its calibration, whether its images are rectified, its own frame."""

    model: CameraModel
    rectified: bool
    frame_id: str

    @property
    def image_frame(self) -> str:
        """The frame of its rectified image: its own, or where R turns that, another of a name made from its own."""
        turned = not np.allclose(self.model.r, np.eye(3), rtol=0, atol=_SAME)
        return f"{self.frame_id}_rectified" if turned and self.frame_id else self.frame_id

    @property
    def image(self) -> Transform:
        """Its rectified image in its own frame."""
        return Transform(self.frame_id, self.image_frame, self.model.r.T, np.zeros(3))


def calibrated_pair(
    models: tuple[CameraModel, CameraModel], names: tuple[str, str], topics: tuple[str, str], frames: TransformTree
) -> tuple[Camera, Camera]:
    """The two cameras of a stereo pair, left and right.

    models: as their CameraInfo tell them; names: of their frames; topics: of their images. The baseline is that of the
    projection matrices, or where these have none (two single calibrations), that of the static transform between the
    cameras. Raises LogError where the log does not tell it.
    """
    left, right = (_checked(model, topic) for model, topic in zip(models, topics, strict=True))
    called = [looks_rectified(topic) for topic in topics]
    states = [name or is_ideal(model) for name, model in zip(called, (left, right), strict=True)]
    if any(called) and not all(states):
        raise LogError(f"of {topics[0]} and {topics[1]} only one is rectified; set 'left' and 'right' to two alike")
    singles = left.p[0, 3] == 0 and right.p[0, 3] == 0
    placed = _placed(names, frames) if singles else None
    rectified = all(states) and (placed is None or _beside(left, right, placed))
    if any(called) and not rectified:
        raise LogError(
            f"{topics[0]} and {topics[1]} are called rectified, but the static transform between them says that "
            "they are not parallel; record the stereo calibration, or the images before rectification"
        )
    for model, topic in zip((left, right), topics, strict=True):
        if not rectified and model.unusable:
            raise LogError(f"the images on {topic} cannot be rectified by their CameraInfo: {model.unusable}")
    if placed is not None:
        left, right = (_joined if rectified else _rectifying)(left, right, placed)
    baseline = float(left.p[0, 3]) / float(left.p[0, 0]) - float(right.p[0, 3]) / float(right.p[0, 0])
    if not baseline > 0:
        raise LogError(
            f"the baseline is {baseline:.4g} m, so {topics[0]} is the right camera: exchange 'left' and 'right' "
            "of the source"
        )
    if differing := left.unlike(right):
        raise LogError(
            f"P of the CameraInfo of {topics[0]} and {topics[1]} are not those of a rectified pair: {differing}; "
            "record the stereo calibration"
        )
    return Camera(left, rectified, names[0]), Camera(right, rectified, names[1])


def baseline_note(
    cameras: tuple[Camera, Camera],
    models: tuple[CameraModel, CameraModel],
    names: tuple[str, str],
    frames: TransformTree,
) -> str:
    """What there is to say of the baseline of `cameras`, as `calibrated_pair` made them of the rest: that the static
    transform between them tells it, or tells another; else empty."""
    placed = frames.between(*names)
    if placed is None or not np.any(placed.translation):
        return ""
    baseline = StereoCamera.from_models(cameras[0].model, cameras[1].model, names[0], rectified=True).baseline
    transform, distance = (
        f"the static transform '{names[0]}' <- '{names[1]}'",
        float(np.linalg.norm(placed.translation)),
    )
    if not any(model.p[0, 3] for model in models):
        return f"the baseline of {baseline:.4g} m is that of {transform}: P[0,3] of both CameraInfo is 0"
    if np.isclose(baseline, distance, rtol=_AGREEING, atol=0):
        return ""
    return (
        f"the baseline is {baseline:.4g} m by P of the CameraInfo, which is used, but {distance:.4g} m by {transform}; "
        "correct the wrong one"
    )


def pinhole(camera: StereoCamera, side: str) -> CameraModel:
    """The calibration of the left or the right one of two rectified cameras, as `StereoCamera.from_models` takes it."""
    cx, shift = (camera.cx, 0.0) if side == "left" else (camera.cx_right, -camera.fx * camera.baseline)
    k = np.array([[camera.fx, 0.0, cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    return CameraModel(camera.width, camera.height, k, np.zeros(5), np.eye(3), np.column_stack([k, [shift, 0.0, 0.0]]))


def is_ideal(model: CameraModel) -> bool:
    """Whether raw and rectified image are the same: no distortion, no rotation, K = P; or there is no K."""
    alike = not np.any(model.k) or np.allclose(model.k, model.p[:, :3])
    return not np.any(model.d) and np.allclose(model.r, np.eye(3)) and alike


def _checked(model: CameraModel, topic: str) -> CameraModel:
    """The calibration; where a single camera left R or P out (zeros), those of a camera that needs no rectification."""
    whose = f"the CameraInfo of {topic}"
    if model.k[0, 0] <= 0 and model.p[0, 0] <= 0:
        raise LogError(f"the camera of {topic} is not calibrated (K and P of its CameraInfo are 0); calibrate it")
    if not np.any(model.r):
        model = replace(model, r=np.eye(3))
    if not model.turns:
        raise LogError(f"R of {whose} is not a rotation; calibrate the camera again")
    if not np.any(model.p):
        model = replace(model, p=np.hstack([model.k, np.zeros((3, 1))]))
    if model.p[0, 0] <= 0 or model.p[1, 1] <= 0:
        raise LogError(f"the focal lengths in P of {whose} are not positive; calibrate the camera again")
    if not all(SHORTEST <= focal <= LONGEST for focal in (model.p[0, 0], model.p[1, 1])):
        raise LogError(f"the focal lengths in P of {whose} are those of no camera; calibrate the camera again")
    if model.width <= 0 or model.height <= 0:
        raise LogError(f"{whose} is for images of {model.width}x{model.height}; calibrate the camera again")
    cx, cy = model.p[0, 2], model.p[1, 2]
    if not (0 <= cx < model.width and 0 <= cy < model.height):
        raise LogError(
            f"the principal point ({cx:g}, {cy:g}) in P of {whose} lies outside its {model.width}x{model.height} "
            "images; record the calibration of images of this size"
        )
    return model


def _placed(names: tuple[str, str], frames: TransformTree) -> Transform:
    """The right camera in the left's frame. Raises LogError where no transform tells, or it is not beside the left."""
    placed = frames.between(*names)
    if placed is None or not np.any(placed.translation):
        raise LogError(
            "the log does not tell the baseline: P[0,3] of the right CameraInfo is 0 and no static transform "
            f"joins '{names[0]}' and '{names[1]}'; record the stereo calibration"
        )
    if abs(placed.translation[0]) < 0.9 * np.linalg.norm(placed.translation):
        raise LogError(
            f"the static transform '{placed.parent}' <- '{placed.child}' has the right camera at "
            f"{placed.translation.tolist()} m, not beside the left one: these are not optical frames (x right, y down, "
            "z forward); name such in CameraInfo"
        )
    return placed


def _beside(left: CameraModel, right: CameraModel, placed: Transform) -> bool:
    """Whether two cameras, each as its rectified image, look in parallel from two places along x, with alike lenses.

    placed: the right camera in the left's frame.
    """
    turned = Rotation.from_matrix(left.r @ placed.rotation @ right.r.T).magnitude()
    x, y, z = left.r @ placed.translation
    return turned < _PARALLEL and max(abs(y), abs(z)) < _BESIDE * abs(x) and not left.unlike(right)


def _joined(left: CameraModel, right: CameraModel, placed: Transform) -> tuple[CameraModel, CameraModel]:
    """A rectified pair, with the baseline that a transform (right camera in the left's frame) tells."""
    projection = right.p.copy()
    projection[0, 3] = -projection[0, 0] * (left.r @ placed.translation)[0]
    return left, replace(right, p=projection)


def _rectifying(left: CameraModel, right: CameraModel, placed: Transform) -> tuple[CameraModel, CameraModel]:
    """The pair with the R and P that rectify it, where a transform (right camera in the left's frame) places it."""
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
    if not made[2][0, 0] > _SHRUNK * left.k[0, 0]:
        raise LogError(
            f"no image of {left.width}x{left.height} px can be rectified with these lenses: the distortion D has no "
            "inverse at the corners; check the calibration"
        )
    return replace(left, r=made[0], p=made[2]), replace(right, r=made[1], p=made[3])
