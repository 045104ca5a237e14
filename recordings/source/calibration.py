"""The calibrated stereo pair of a log.

The rectifying rotation R (CameraInfo) turns a camera's own coordinates into those of its rectified image. The
transforms of a log refer to the camera's own frame. So the rectified image has a frame of its own wherever R is not 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from flow.contracts import Finding, Severity
from recordings.discovery.images import looks_rectified
from recordings.errors import LogError
from recordings.source.transforms import TRANSFORM_ATOL, TransformTree
from stages.data import CameraModel, StereoCamera, Transform
from stages.data.rotations import angle_of

MAX_PARALLEL_RAD = 1e-3  # parallel cameras are turned against each other by less: 1 pixel at 1000 px
MAX_OFFSET_SHARE = 0.01  # of the baseline; parallel cameras are displaced against each other in y and z by less
MIN_BASELINE, MAX_BASELINE = 1 / 500, 10.0  # of the camera's height; beyond, it is in another unit or misplaced
ASSUMED_HEIGHT = 1.0  # m, of a camera whose height is unknown
BASELINE_RTOL = 0.05  # two baselines that differ by less agree
MIN_FOCAL_PX, MAX_FOCAL_PX = 1.0, 1e6
_SIDE_BY_SIDE = (
    "but stereo needs both side by side; rotate the images by 90 degrees before they are calibrated and logged"
)
MIN_RECTIFIED_SCALE = 0.1  # of the focal length; a smaller rectified image means that D is wrong


@dataclass(frozen=True)
class Camera:
    """One camera. rectified: whether its images are; frame_id: the camera's own frame."""

    model: CameraModel
    rectified: bool
    frame_id: str

    @cached_property
    def image_frame(self) -> str:
        """The frame of its rectified image: `frame_id`, or with a rotation R, `frame_id` and "_rectified"."""
        turned = not np.allclose(self.model.r, np.eye(3), rtol=0, atol=TRANSFORM_ATOL)
        return f"{self.frame_id}_rectified" if turned and self.frame_id else self.frame_id

    @property
    def image(self) -> Transform:
        """The transform from its rectified image to its own frame."""
        return Transform(self.frame_id, self.image_frame, self.model.r.T, np.zeros(3))


def calibrated_pair(
    models: tuple[CameraModel, CameraModel], names: tuple[str, str], topics: tuple[str, str], tree: TransformTree
) -> tuple[Camera, Camera]:
    """The left and the right camera of a stereo pair, with the names of their frames and the topics of their images.

    The baseline comes from the projection matrices P. If both P[0, 3] are 0 (two single calibrations), it comes from
    the static transform between the cameras. Images on a topic such as /left/image_rect are rectified. Raises LogError
    if the two are not a stereo pair, or the baseline is unknown.

    >>> k = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    >>> left, right = (np.column_stack([k, [shift, 0, 0]]) for shift in (0.0, -100.0))
    >>> models = tuple(CameraModel(640, 480, k, np.zeros(5), np.eye(3), p) for p in (left, right))
    >>> cameras = calibrated_pair(models, ("left", "right"), ("/left/image_rect", "/right/image_rect"), TransformTree())
    >>> StereoCamera.from_models(cameras[0].model, cameras[1].model, "left", rectified=True).baseline
    0.2
    """
    left, right = (_validated(model, topic) for model, topic in zip(models, topics, strict=True))
    by_name = [looks_rectified(topic) for topic in topics]
    states = [name or is_ideal(model) for name, model in zip(by_name, (left, right), strict=True)]
    if any(by_name) and not all(states):
        raise LogError(
            f"only one of {topics[0]} and {topics[1]} is rectified; set 'left' and 'right' to two of one kind"
        )
    if abs(right.p[1, 3]) > abs(right.p[0, 3]):
        raise LogError(
            f"the camera of {topics[1]} is above or below that of {topics[0]} (P[1,3] is {right.p[1, 3]:.4g}), "
            f"{_SIDE_BY_SIDE}"
        )
    singles = left.p[0, 3] == 0 and right.p[0, 3] == 0
    right_in_left = _right_in_left(names, tree) if singles else None
    rectified = all(states) and (right_in_left is None or _is_parallel(left, right, right_in_left))
    if any(by_name) and not rectified:
        raise LogError(
            f"{topics[0]} and {topics[1]} are rectified by their names, but the cameras are not parallel by the static "
            "transform between them; record the stereo calibration, or the images before rectification"
        )
    for model, topic in zip((left, right), topics, strict=True):
        if not rectified and model.unusable:
            raise LogError(f"the images on {topic} cannot be rectified with their CameraInfo: {model.unusable}")
    if right_in_left is not None and rectified:
        right = _with_baseline(left, right, right_in_left)
    elif right_in_left is not None:
        left, right = _rectify_pair(left, right, right_in_left)
    baseline = float(left.p[0, 3]) / float(left.p[0, 0]) - float(right.p[0, 3]) / float(right.p[0, 0])
    if not baseline > 0:
        raise LogError(
            f"the baseline is {baseline:.4g} m, so {topics[0]} is the right camera; exchange 'left' and 'right' "
            "of the source"
        )
    if differing := left.unlike(right):
        raise LogError(
            f"P in the CameraInfo of {topics[0]} and {topics[1]} does not belong to a rectified pair: {differing}; "
            "record the stereo calibration"
        )
    return Camera(left, rectified, names[0]), Camera(right, rectified, names[1])


def baseline_note(
    cameras: tuple[Camera, Camera], models: tuple[CameraModel, CameraModel], names: tuple[str, str], tree: TransformTree
) -> Finding | None:
    """A note if the baseline of a calibrated pair comes from a static transform, a warning if it contradicts it."""
    right_in_left = tree.between(*names)
    if right_in_left is None or not np.any(right_in_left.translation):
        return None
    baseline = StereoCamera.from_models(cameras[0].model, cameras[1].model, names[0], rectified=True).baseline
    distance = float(np.linalg.norm(right_in_left.translation))
    transform = f"the static transform '{names[0]}' <- '{names[1]}'"
    if not any(model.p[0, 3] for model in models):
        return Finding(
            f"the baseline of {baseline:.4g} m comes from {transform}, because P[0,3] of both CameraInfo is 0"
        )
    if np.isclose(baseline, distance, rtol=BASELINE_RTOL, atol=0):
        return None
    return Finding(
        f"the baseline is {baseline:.4g} m by P of the CameraInfo, which is used, but {distance:.4g} m by {transform}; "
        "correct the wrong one",
        Severity.WARNING,
    )


def baseline_fault(baseline: float, height: float) -> Finding | None:
    """A fault if a baseline, m, is out of proportion to the camera's height, m, above the rover's base frame.

    A height of 0 or less is that of no ground.

    >>> [baseline_fault(*each) for each in ((0.24, 0.9), (0.24, 0.0), (0.24, 0.02), (0.0008, 0.02))]
    [None, None, None, None]
    """
    low = height if height > 0 else ASSUMED_HEIGHT
    if MIN_BASELINE * low <= baseline <= MAX_BASELINE * max(low, ASSUMED_HEIGHT):
        return None
    return Finding(
        f"the baseline of {baseline:.3g} m is out of proportion to the camera's height of {low:.3g} m"
        f"{'' if height > 0 else ', as assumed'}, so all lengths are wrong; correct the calibration (P[0,3] is the "
        "focal length in px times metres), or record the camera's height in /tf_static",
        Severity.FAULT,
        about="cameras",
    )


def pinhole(camera: StereoCamera, side: str) -> CameraModel:
    """The calibration of one side ("left" or "right") of a rectified camera."""
    cx, shift = (camera.cx, 0.0) if side == "left" else (camera.cx_right, -camera.fx * camera.baseline)
    k = np.array([[camera.fx, 0.0, cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    return CameraModel(camera.width, camera.height, k, np.zeros(5), np.eye(3), np.column_stack([k, [shift, 0.0, 0.0]]))


def is_ideal(model: CameraModel) -> bool:
    """Whether raw and rectified image are the same: no distortion, no rotation, and K = P or no K."""
    same_k = not np.any(model.k) or np.allclose(model.k, model.p[:, :3])
    return not np.any(model.d) and np.allclose(model.r, np.eye(3)) and same_k


def _validated(model: CameraModel, topic: str) -> CameraModel:
    """The calibration, with R = 1 and P = K if they are zero, as a single camera may leave them."""
    whose = f"the CameraInfo of {topic}"
    if model.k[0, 0] <= 0 and model.p[0, 0] <= 0:
        raise LogError(
            f"the camera of {topic} is not calibrated (K and P of its CameraInfo are 0); set 'calibration' "
            "of the source to its file"
        )
    if not np.any(model.r):
        model = replace(model, r=np.eye(3))
    if not model.turns:
        raise LogError(f"R of {whose} is not a rotation; calibrate the camera again")
    if not np.any(model.p):
        model = replace(model, p=np.hstack([model.k, np.zeros((3, 1))]))
    if model.p[0, 0] <= 0 or model.p[1, 1] <= 0:
        raise LogError(f"the focal lengths in P of {whose} are not positive; calibrate the camera again")
    if not all(MIN_FOCAL_PX <= focal <= MAX_FOCAL_PX for focal in (model.p[0, 0], model.p[1, 1])):
        raise LogError(f"the focal lengths in P of {whose} are impossible for a camera; calibrate the camera again")
    if model.width <= 0 or model.height <= 0:
        raise LogError(f"{whose} is for images of {model.width}x{model.height}; calibrate the camera again")
    cx, cy = model.p[0, 2], model.p[1, 2]
    if not (0 <= cx < model.width and 0 <= cy < model.height):
        raise LogError(
            f"the principal point ({cx:g}, {cy:g}) in P of {whose} lies outside its {model.width}x{model.height} "
            "images; record the calibration of images of this size"
        )
    return model


def _right_in_left(names: tuple[str, str], tree: TransformTree) -> Transform:
    """The transform from the right camera to the left one. Raises LogError if there is none, or not along x."""
    right_in_left, why = tree.between(*names), "P[0,3] of the right CameraInfo is 0"
    if right_in_left is None:
        raise LogError(
            f"the log does not contain the baseline: {why} and no static transform joins '{names[0]}' and "
            f"'{names[1]}'; record the stereo calibration"
        )
    if not np.any(right_in_left.translation):
        raise LogError(
            f"the baseline is 0 m: {why}, and '{names[0]}' and '{names[1]}' are at the same place by the static "
            "transforms; record the stereo calibration"
        )
    translation = right_in_left.translation
    if abs(translation[0]) < 0.9 * np.linalg.norm(translation):
        above = (
            f"; or one camera is above the other, {_SIDE_BY_SIDE}" if abs(translation[1]) > abs(translation[2]) else ""
        )
        raise LogError(
            f"the static transform '{right_in_left.parent}' <- '{right_in_left.child}' has the right camera at "
            f"{translation.round(3).tolist()} m, not beside the left one: these are not optical frames (x right, "
            f"y down, z forward); name optical frames in CameraInfo{above}"
        )
    return right_in_left


def _is_parallel(left: CameraModel, right: CameraModel, right_in_left: Transform) -> bool:
    """Whether two cameras look in parallel from two places along x, with equal lenses."""
    angle = angle_of(left.r @ right_in_left.rotation @ right.r.T)
    x, y, z = left.r @ right_in_left.translation
    return angle < MAX_PARALLEL_RAD and max(abs(y), abs(z)) < MAX_OFFSET_SHARE * abs(x) and not left.unlike(right)


def _with_baseline(left: CameraModel, right: CameraModel, right_in_left: Transform) -> CameraModel:
    """The right camera of a rectified pair, its P with the baseline of the transform."""
    projection = right.p.copy()
    projection[0, 3] = -projection[0, 0] * (left.r @ right_in_left.translation)[0]
    return replace(right, p=projection)


def _rectify_pair(left: CameraModel, right: CameraModel, right_in_left: Transform) -> tuple[CameraModel, CameraModel]:
    """The pair with the R and P that rectify it."""
    inverse = right_in_left.inverse()
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
    if not MIN_RECTIFIED_SCALE * left.k[0, 0] < made[2][0, 0] < np.inf:
        raise LogError(
            f"no image of {left.width}x{left.height} px can be rectified with these lenses: the distortion D has no "
            "inverse at the corners; check the calibration"
        )
    return replace(left, r=made[0], p=made[2]), replace(right, r=made[1], p=made[3])
