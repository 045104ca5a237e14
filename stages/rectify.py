"""Rectification: both images resampled so that corresponding points lie on the same row.

Each camera's undistortion and rectifying rotation are folded into one table of source positions (Bouguet's method, as
in image_pipeline), computed once per camera and then only looked up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from stages.data import Array, CameraModel, StereoFrame
from stages.stage import Stage, parameter

DISTORTION_SIZES = {"plumb_bob": (0, 4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,)}


@dataclass(frozen=True)
class Rectify(Stage):
    """A stereo frame with row-aligned images; rectified input passes through but for the row correction.

    Pixels that no raw pixel maps to are 0.
    """

    row_offset: float = parameter(
        0.0,
        "rows by which rectification leaves a point lower in the left image than in the right one (v_left - v_right);"
        " the right image is moved down by as many (Devon Island: +0.6)",
        unit="px",
        low=-64,
        high=64,
    )

    def __call__(self, frame: StereoFrame) -> StereoFrame:
        camera = frame.camera
        if camera.raw is None:
            right = _moved_down(frame.right, self.row_offset) if self.row_offset else frame.right
            return replace(frame, right=right)
        left_maps = _rectifying_maps(*_frozen(camera.raw[0]), 0.0)
        right_maps = _rectifying_maps(*_frozen(camera.raw[1]), self.row_offset)
        left = cv2.remap(frame.left, *left_maps, cv2.INTER_CUBIC)
        right = cv2.remap(frame.right, *right_maps, cv2.INTER_CUBIC)
        return StereoFrame(frame.stamp, left, right, replace(camera, raw=None))


def _moved_down(image: Array, rows: float) -> Array:
    """The image moved down by `rows`, bicubic, so that a shift by part of a row blurs least."""
    move = np.array([[1, 0, 0], [0, 1, rows]], np.float64)
    size = image.shape[1], image.shape[0]
    moved: Array = cv2.warpAffine(image, move, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return moved


def _frozen(model: CameraModel) -> tuple[str, int, int, bytes]:
    """The calibration as a hashable value: equal calibrations share their maps, whatever object holds them."""
    values = np.concatenate([model.k.ravel(), model.r.ravel(), model.p.ravel(), model.d.ravel()])
    return model.model, model.width, model.height, values.tobytes()


@lru_cache(maxsize=4)
def _rectifying_maps(model: str, width: int, height: int, values: bytes, rows_down: float) -> tuple[Array, Array]:
    """Where in the raw image each rectified pixel lies, in cv2.remap's fixed-point form."""
    numbers = np.frombuffer(values)
    k, r, p, d = numbers[:9].reshape(3, 3), numbers[9:18].reshape(3, 3), numbers[18:30].reshape(3, 4), numbers[30:]
    projection = p[:, :3].copy()
    projection[1, 2] += rows_down
    if model not in DISTORTION_SIZES:
        raise ValueError(f"Rectify: unknown distortion model '{model}'; use {', '.join(DISTORTION_SIZES)}")
    if d.size not in DISTORTION_SIZES[model]:
        raise ValueError(
            f"Rectify: a {model} camera has {' or '.join(map(str, DISTORTION_SIZES[model]))} distortion coefficients, "
            f"the calibration has {d.size}"
        )
    undistort = cv2.fisheye.initUndistortRectifyMap if model == "equidistant" else cv2.initUndistortRectifyMap
    maps = undistort(k, d, r, projection, (width, height), cv2.CV_16SC2)
    return maps[0], maps[1]
