"""Cameras and their images: one calibrated camera, the rectified pair, the stereo frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from typing import Any, TypeVar, cast

import numpy as np

from flow.contracts import StageError
from stages.data.arrays import Array, publish, publish_image, publish_plain, publish_vector

CALIBRATION_RTOL = 1e-3  # by which focal lengths or cy of a rectified pair may differ: a pixel at 1000 px
_OPENCV = (0, 4, 5, 8, 12, 14)  # numbers of coefficients; they define the model, whatever a driver calls it
DISTORTION_SIZES = {"plumb_bob": _OPENCV, "rational_polynomial": _OPENCV, "equidistant": (4,)}
Derived = TypeVar("Derived")


@dataclass(frozen=True, eq=False)
class CameraModel:
    """Calibration of one camera, the fields of sensor_msgs/CameraInfo.

    Parameters
    ----------
    width, height
        Size of the image, px.
    k
        (3, 3) intrinsics of the raw image, px.
    d
        (n,) distortion coefficients.
    r
        (3, 3) rectifying rotation.
    p
        (3, 4) projection of the rectified image, px; p[0, 3] = -fx * baseline for the right camera of a pair.
    model
        "plumb_bob", "rational_polynomial" or "equidistant".

    Examples
    --------
    >>> import numpy as np
    >>> from stages import CameraModel, StereoCamera
    >>> k = np.array([[500, 0, 320], [0, 500, 240], [0, 0, 1]])
    >>> left, right = np.c_[k, [0, 0, 0]], np.c_[k, [-60, 0, 0]]
    >>> models = [CameraModel(640, 480, k=k, d=np.zeros(5), r=np.eye(3), p=p) for p in (left, right)]
    >>> StereoCamera.from_models(*models, frame_id="camera", rectified=True).baseline
    0.12
    """

    width: int
    height: int
    k: Array
    d: Array
    r: Array
    p: Array
    model: str = "plumb_bob"

    def __post_init__(self) -> None:
        for name, shape in (("k", (3, 3)), ("d", (np.size(self.d),)), ("r", (3, 3)), ("p", (3, 4))):
            publish_vector(self, name, shape)

    @property
    def turns(self) -> bool:
        """Whether R is a rotation."""
        return bool(np.allclose(self.r @ self.r.T, np.eye(3), atol=1e-3) and np.linalg.det(self.r) > 0)

    def unlike(self, right: CameraModel) -> str:
        """The difference of two projections that a rectified pair must not have; empty if there is none."""
        shared = {"fx": (0, 0), "fy": (1, 1), "cy": (1, 2)}
        pairs = {name: (float(self.p[place]), float(right.p[place])) for name, place in shared.items()}
        differing = [name for name, values in pairs.items() if not math.isclose(*values, rel_tol=CALIBRATION_RTOL)]
        return " and ".join(f"{name} is {pairs[name][0]:.6g} and {pairs[name][1]:.6g} px" for name in differing)

    @property
    def unusable(self) -> str:
        """Why a raw image cannot be rectified with this calibration; empty if it can."""
        sizes = DISTORTION_SIZES.get(self.model)
        if sizes is None:
            return f"unknown distortion model '{self.model}'; use {', '.join(DISTORTION_SIZES)}"
        if self.d.size not in sizes:
            wanted = " or ".join(map(str, sizes))
            return f"a {self.model} camera has {wanted} distortion coefficients, the calibration has {self.d.size}"
        if not min(self.k[0, 0], self.k[1, 1]) > 0:
            return "the calibration of a raw image has no focal length in K"
        if not self.turns:
            return "R of the calibration is not a rotation"
        return ""


@dataclass(frozen=True, eq=False)
class StereoCamera:
    """A rectified stereo camera: Z = fx * baseline / (d + cx_right - cx), x_right = x_left - d.

    Parameters
    ----------
    fx, fy, cx, cy, cx_right
        Intrinsics of the rectified images, px; `cx_right` is `cx` by default.
    baseline
        Distance of the cameras, m, above 0.
    width, height
        Size of the images, px.
    frame_id
        The left optical frame.
    raw
        Calibrations of the left and the right camera if the images are not rectified yet, else None.

    Examples
    --------
    >>> from stages import StereoCamera
    >>> camera = StereoCamera(fx=500, fy=500, cx=320, cy=240, baseline=0.12, width=640, height=480)
    >>> disparity = 20
    >>> camera.fx * camera.baseline / (disparity + camera.cx_right - camera.cx)
    3.0
    """

    fx: float
    fy: float
    cx: float
    cy: float
    baseline: float
    width: int
    height: int
    cx_right: float = cast(float, None)
    frame_id: str = "camera"
    raw: tuple[CameraModel, CameraModel] | None = None

    def __post_init__(self) -> None:
        if self.cx_right is None:
            object.__setattr__(self, "cx_right", self.cx)
        for name in ("fx", "fy", "cx", "cy", "cx_right", "baseline", "width", "height"):
            if not isinstance(getattr(self, name), Real):
                raise StageError(f"StereoCamera.{name} must be a number, not {getattr(self, name)!r}")
        for name in ("fx", "fy", "baseline", "width", "height"):
            if not getattr(self, name) > 0:
                raise StageError(f"StereoCamera.{name} must be positive, not {getattr(self, name)}")
        if not np.all(np.isfinite([self.fx, self.fy, self.cx, self.cy, self.cx_right, self.baseline])):
            raise StageError("StereoCamera has a calibration value that is not finite")

    @classmethod
    def from_models(cls, left: CameraModel, right: CameraModel, frame_id: str, rectified: bool) -> StereoCamera:
        """The rectified camera of two projection matrices.

        Raises
        ------
        ValueError
            If the projections are not those of a rectified pair.
        """
        if differing := left.unlike(right):
            raise StageError(f"the cameras' P are not those of a rectified pair: {differing}")
        return cls(
            fx=float(left.p[0, 0]), fy=float(left.p[1, 1]), cx=float(left.p[0, 2]), cy=float(left.p[1, 2]),
            baseline=float(left.p[0, 3] / left.p[0, 0] - right.p[0, 3] / right.p[0, 0]),
            width=left.width, height=left.height, cx_right=float(right.p[0, 2]), frame_id=frame_id,
            raw=None if rectified else (left, right),
        )  # fmt: skip

    @property
    def doubts(self) -> tuple[str, ...]:
        """Unusual values of the calibration, a sentence each: it may be for another image size."""
        size, doubts = f"{self.width}x{self.height}", []
        for name, extent in (("cx", self.width), ("cx_right", self.width), ("cy", self.height)):
            if not 0.2 * extent <= getattr(self, name) <= 0.8 * extent:
                outer = f"{name} of {getattr(self, name):g} px lies in the outer fifth of {size} images"
                doubts.append(f"{outer}: check that the calibration is for this size")
        if not 0.005 <= self.baseline <= 5:
            doubts.append(f"the baseline is {self.baseline:g} m: check that it is given in metres")
        return tuple(doubts)


@dataclass(frozen=True, eq=False)
class CameraImage:
    """One image of one camera, with its calibration.

    Parameters
    ----------
    stamp
        Nanoseconds.
    pixels
        (H, W) gray or (H, W, 3) RGB, uint8 or uint16.
    model
        The calibration.
    frame_id
        The camera's optical frame.
    rectified
        Whether `pixels` are rectified.
    """

    stamp: int
    pixels: Array
    model: CameraModel
    frame_id: str
    rectified: bool

    def __post_init__(self) -> None:
        publish_plain(self)
        publish_image(self, "pixels")

    def pair_with(self, right: CameraImage) -> StereoFrame:
        """The stereo frame of this (left) image and the right one, with the stamp of the left image."""
        camera = StereoCamera.from_models(self.model, right.model, self.frame_id, self.rectified and right.rectified)
        return StereoFrame(self.stamp, self.pixels, right.pixels, camera)


@dataclass(frozen=True, eq=False)
class StereoFrame:
    """Left and right image, taken at one time.

    Parameters
    ----------
    stamp
        Nanoseconds.
    left, right
        (H, W) gray or (H, W, 3) RGB, uint8 or uint16. One may be gray and the other RGB.
    camera
        The stereo camera.

    Examples
    --------
    >>> import numpy as np
    >>> from stages import StereoCamera, StereoFrame
    >>> camera = StereoCamera(fx=500, fy=500, cx=320, cy=240, baseline=0.12, width=640, height=480)
    >>> StereoFrame(0, np.zeros((480, 640), np.uint8), np.zeros((480, 640), np.uint8), camera).left.shape
    (480, 640)
    """

    stamp: int
    left: Array
    right: Array
    camera: StereoCamera

    def __post_init__(self) -> None:
        publish_plain(self)
        publish_image(self, "left")
        publish_image(self, "right")
        if self.left.shape[:2] != self.right.shape[:2]:
            raise StageError(f"StereoFrame: left is {self.left.shape}, right is {self.right.shape}")
        if self.left.dtype != self.right.dtype:
            raise StageError(f"StereoFrame: left is {self.left.dtype}, right is {self.right.dtype}; record both alike")
        if self.left.shape[:2] != (self.camera.height, self.camera.width):
            raise StageError(
                f"StereoFrame: images are {self.left.shape[1]}x{self.left.shape[0]}, "
                f"the calibration is for {self.camera.width}x{self.camera.height}"
            )

    @cached_property
    def _derived(self) -> dict[Any, Any]:
        return {}

    def once(self, derive: Callable[..., Derived], *given: Hashable) -> Derived:
        """`derive(frame, *given)`, which is kept: stages share what they derive from the same images."""
        key = derive, given
        if key not in self._derived:
            self._derived[key] = derive(self, *given)
        return cast(Derived, self._derived[key])


@dataclass(frozen=True, eq=False)
class ImageNoise:
    """The noise of an image.

    Parameters
    ----------
    stamp
        Nanoseconds.
    sigma
        (256,) float32: standard deviation of a pixel at each gray level, in gray levels of 8 bit.
    """

    stamp: int
    sigma: Array

    def __post_init__(self) -> None:
        publish_plain(self)
        publish(self, "sigma", (256,), np.float32)
