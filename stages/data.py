"""The data that flows: frozen dataclasses, one per kind of thing a stage takes or makes.

Conventions, everywhere: `stamp` is int nanoseconds of the log's clock; lengths are metres, angles radians; arrays are
read-only once published; unknown is NaN (or -1 where the type says so), never a number that could be a value.

Camera frame: left optical frame, x right, y down, z forward. Level frame: z up against gravity, x the rover's
horizontal heading, y left.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from types import MappingProxyType
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stages.publish import check_rotation, publish, publish_image, publish_vector, read_only
from stages.tiles import Tiles as Tiles

Array = NDArray[Any]

LEVEL_FRAME = "level"


class Source(IntEnum):
    """Where a disparity comes from, the codes of `Disparity.source`.

    MEASURED: matched at this pixel; PLANE: the surface that the matches about it agree on, be there no match at this
    pixel or one that disagrees; FILLED: guessed from beside.
    """

    UNKNOWN = 0
    MEASURED = 1
    PLANE = 2
    FILLED = 3


class Cell(IntEnum):
    """The three states of `NavigationMap.cells`."""

    UNKNOWN = -1
    FREE = 0
    HAZARD = 100


class Reason(IntEnum):
    """Why a navigation cell has its state, the codes of `NavigationMap.reason`."""

    CLEAR = 0
    UNOBSERVED = 1
    ELEVATION = 2
    STEP = 3
    SLOPE = 4
    ROUGHNESS = 5
    CLEARANCE = 6  # it would touch the rover's belly
    BESIDE = 7  # next to a hazard, by less than where heights lie is known
    OCCLUDED = 8  # unknown: hidden from the cameras, or not matched, amid ground that was measured
    UNSURE = 9  # unknown: measured, but on too little evidence


@dataclass(frozen=True, eq=False)
class Transform:
    """A rigid transform: a point p of frame `child` is `rotation @ p + translation` in frame `parent`.

    rotation: (3, 3) float64, orthonormal; translation: (3,) float64, metres.
    """

    parent: str
    child: str
    rotation: Array
    translation: Array

    def __post_init__(self) -> None:
        publish_vector(self, "rotation", (3, 3))
        publish_vector(self, "translation", (3,))
        check_rotation(self.rotation, f"Transform {self.parent} <- {self.child}: rotation")

    def __call__(self, points: ArrayLike) -> Array:
        """Points (N, 3) of `child`, expressed in `parent`."""
        return np.asarray(points) @ self.rotation.T + self.translation

    def inverse(self) -> Transform:
        """The transform from `parent` to `child`."""
        return Transform(self.child, self.parent, self.rotation.T, -self.rotation.T @ self.translation)

    def after(self, first: Transform) -> Transform:
        """The transform that applies `first`, then this one."""
        return Transform(self.parent, first.child, self.rotation @ first.rotation, self(first.translation))


@dataclass(frozen=True, eq=False)
class CameraModel:
    """Calibration of one camera, the fields of sensor_msgs/CameraInfo.

    k: (3, 3) intrinsics of the raw image, px; d: (n,) distortion coefficients; model: "plumb_bob",
    "rational_polynomial" or "equidistant"; r: (3, 3) rectifying rotation; p: (3, 4) projection of the rectified image,
    px, with p[0, 3] = -fx * baseline for the right camera of a pair.
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


@dataclass(frozen=True, eq=False)
class StereoCamera:
    """A rectified stereo camera: Z = fx * baseline / (d + cx_right - cx), x_right = x_left - d.

    fx, fy, cx, cy, cx_right: px of the left rectified image; baseline: m, > 0; width, height: px; frame_id: the left
    optical frame; raw: both cameras' own calibration where the images still have to be rectified, else None.
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
        for name in ("fx", "fy", "baseline", "width", "height"):
            if not getattr(self, name) > 0:
                raise ValueError(f"StereoCamera.{name} must be positive, not {getattr(self, name)}")
        if not np.all(np.isfinite([self.fx, self.fy, self.cx, self.cy, self.cx_right, self.baseline])):
            raise ValueError("StereoCamera has a calibration value that is not finite")

    @classmethod
    def from_models(cls, left: CameraModel, right: CameraModel, frame_id: str, rectified: bool) -> StereoCamera:
        """The rectified camera that two CameraInfo messages describe through their projection matrices."""
        return cls(
            fx=float(left.p[0, 0]), fy=float(left.p[1, 1]), cx=float(left.p[0, 2]), cy=float(left.p[1, 2]),
            baseline=float(left.p[0, 3] / left.p[0, 0] - right.p[0, 3] / right.p[0, 0]),
            width=left.width, height=left.height, cx_right=float(right.p[0, 2]), frame_id=frame_id,
            raw=None if rectified else (left, right),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class CameraImage:
    """One image of one camera, with its calibration.

    pixels: uint8 or uint16, (H, W) or (H, W, 3) RGB; rectified: whether `pixels` are rectified already.
    """

    stamp: int
    pixels: Array
    model: CameraModel
    frame_id: str
    rectified: bool

    def __post_init__(self) -> None:
        publish_image(self, "pixels")

    def pair_with(self, right: CameraImage) -> StereoFrame:
        """The stereo frame of this (left) image and its right partner; it carries the left image's stamp."""
        if self.pixels.shape != right.pixels.shape:
            raise ValueError(f"left image is {self.pixels.shape}, right image is {right.pixels.shape}")
        camera = StereoCamera.from_models(self.model, right.model, self.frame_id, self.rectified and right.rectified)
        return StereoFrame(self.stamp, self.pixels, right.pixels, camera)


@dataclass(frozen=True, eq=False)
class StereoFrame:
    """A pair of images taken at one time. left, right: uint8 or uint16, (H, W) or (H, W, 3) RGB."""

    stamp: int
    left: Array
    right: Array
    camera: StereoCamera

    def __post_init__(self) -> None:
        publish_image(self, "left")
        publish_image(self, "right")
        if self.left.shape != self.right.shape:
            raise ValueError(f"StereoFrame: left is {self.left.shape}, right is {self.right.shape}")
        if self.left.shape[:2] != (self.camera.height, self.camera.width):
            raise ValueError(
                f"StereoFrame: images are {self.left.shape[1]}x{self.left.shape[0]}, "
                f"the calibration is for {self.camera.width}x{self.camera.height}"
            )


@dataclass(frozen=True, eq=False)
class Tilt:
    """Where up is. up: (3,) float64 unit vector, gravity's opposite, in the inclinometer's frame `frame_id`."""

    stamp: int
    up: Array
    frame_id: str = "inclinometer"

    def __post_init__(self) -> None:
        publish_vector(self, "up", (3,))
        if not abs(float(np.linalg.norm(self.up)) - 1.0) < 1e-6:
            raise ValueError(f"Tilt.up must be a unit vector, not {self.up.tolist()}")

    def interpolated(self, later: Tilt, stamp: int) -> Tilt:
        """The tilt at `stamp`, between this one and a later one, along the great circle."""
        return Tilt(stamp, _slerp(self.up, later.up, _share(self.stamp, later.stamp, stamp)), self.frame_id)

    @staticmethod
    def smoothed(samples: Sequence[Tilt], stamp: int) -> Tilt:
        """The tilt at `stamp` by the straight line, in time, that fits three samples about it or more."""
        seconds = (np.array([sample.stamp for sample in samples]) - stamp) / 1e9
        line = np.column_stack([np.ones_like(seconds), seconds])
        up = np.linalg.lstsq(line, np.array([sample.up for sample in samples]), rcond=None)[0][0]
        length = float(np.linalg.norm(up))
        if not length > 0.5:
            raise ValueError("Tilt.smoothed: the samples point all ways")
        return Tilt(stamp, up / length, samples[0].frame_id)


@dataclass(frozen=True, eq=False)
class Pose:
    """Pose of frame `child_frame_id` in frame `frame_id`.

    position: (3,) float64, m; quaternion: (4,) float64, xyzw, unit; covariance: (6, 6) over position and rotation
    about the fixed axes, or None.
    """

    stamp: int
    position: Array
    quaternion: Array
    frame_id: str
    child_frame_id: str
    covariance: Array | None = None

    def __post_init__(self) -> None:
        publish_vector(self, "position", (3,))
        publish_vector(self, "quaternion", (4,))
        if self.covariance is not None:
            publish_vector(self, "covariance", (6, 6), finite=False)
        if not abs(float(np.linalg.norm(self.quaternion)) - 1.0) < 1e-3:
            raise ValueError(f"Pose.quaternion must be a unit quaternion, not {self.quaternion.tolist()}")

    def interpolated(self, later: Pose, stamp: int) -> Pose:
        """The pose at `stamp`, between this one and a later one; the earlier covariance is kept."""
        share = _share(self.stamp, later.stamp, stamp)
        position = (1 - share) * self.position + share * later.position
        near = later.quaternion if self.quaternion @ later.quaternion >= 0 else -later.quaternion
        return replace(self, stamp=stamp, position=position, quaternion=_slerp(self.quaternion, near, share))


@dataclass(frozen=True, eq=False)
class Mount:
    """How the camera sits on the rover.

    camera_from_inclinometer: (3, 3) float64 rotation; base_from_camera: the left camera in the rover's base frame
    (x forward, y left, z up), or None where the log does not say.
    """

    stamp: int
    camera_from_inclinometer: Array
    base_from_camera: Transform | None = None

    def __post_init__(self) -> None:
        publish_vector(self, "camera_from_inclinometer", (3, 3))
        check_rotation(self.camera_from_inclinometer, "Mount.camera_from_inclinometer")


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """How the camera moved, by the images alone: nothing but they constrains it, gravity neither.

    camera: the camera in the camera of the frame that began its segment, None where the images do not tell; segment:
    counts from 1, a new one begins wherever tracking was lost, and nothing ties it to the one before; covariance:
    (6, 6) of `camera`, of position (m) and of a turn (rad) about the fixed axes, which grows from step to step;
    inliers: features that agree on the last step; error: their root mean square reprojection error, px (NaN for none);
    lost: what to say where tracking was lost at this frame, else empty.
    """

    stamp: int
    segment: int
    camera: Transform | None
    covariance: Array
    inliers: int = 0
    error: float = float("nan")
    lost: str = ""

    def __post_init__(self) -> None:
        publish_vector(self, "covariance", (6, 6))


@dataclass(frozen=True, eq=False)
class TiltHealth:
    """Whether the tilt can be believed, judged by the camera and the ground it sees.

    turn: rad, between the tilt and the one before carried along by the camera's motion; ground: rad, between up and the
    upward normal of the ground in view; both NaN where unknown. frames: how many frames the judgement rests on. fault:
    what is wrong, in a word or two, empty where nothing is or nothing can be told; judgement: a sentence.
    """

    stamp: int
    turn: float
    ground: float
    frames: int
    fault: str
    judgement: str


@dataclass(frozen=True, eq=False)
class Disparity:
    """A disparity image in the left rectified frame.

    pixels: (H, W) float32, px, NaN = unknown; source: (H, W) uint8, codes of `Source`; confidence: (H, W) float32 in
    [0, 1]; segments: (H, W) int32 superpixel labels where refinement made them, else None; camera: the rectified camera
    it was made for, where known.
    """

    stamp: int
    pixels: Array
    source: Array
    confidence: Array
    segments: Array | None = None
    camera: StereoCamera | None = None

    def __post_init__(self) -> None:
        publish(self, "pixels", (None, None), np.float32)
        publish(self, "source", self.pixels.shape, np.uint8)
        publish(self, "confidence", self.pixels.shape, np.float32)
        if self.segments is not None:
            publish(self, "segments", self.pixels.shape, np.int32)


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points of the left image in space.

    points: (N, 3) float32, m, in `frame_id`; colors: (N, 3) uint8 RGB; sigma: (N,) float32, depth standard deviation,
    m; pixel: (N,) int32, index into the flattened left image; sensor: where the camera is in `frame_id`, None where
    the cloud is still in the camera's own frame; shape: (H, W) of the left image that `pixel` indexes, where known;
    source: (N,) uint8, codes of `Source`, None where all points are measured; tilt_sigma: standard deviation of the
    direction of up that the cloud was levelled with, about each horizontal axis, rad.
    """

    stamp: int
    points: Array
    colors: Array
    sigma: Array
    pixel: Array
    frame_id: str
    shape: tuple[int, int] | None = None
    sensor: Transform | None = None
    source: Array | None = None
    tilt_sigma: float = 0.0

    def __post_init__(self) -> None:
        publish(self, "points", (None, 3), np.float32)
        n = len(self.points)
        publish(self, "colors", (n, 3), np.uint8)
        publish(self, "sigma", (n,), np.float32)
        publish(self, "pixel", (n,), np.int32)
        if self.source is not None:
            publish(self, "source", (n,), np.uint8)

    def only(self, kept: Array) -> PointCloud:
        """The points of the indices or the mask `kept`, in that order."""
        kept = np.flatnonzero(kept) if kept.dtype == bool else kept
        return replace(
            self,
            points=self.points.take(kept, axis=0),
            colors=self.colors.take(kept, axis=0),
            sigma=self.sigma.take(kept),
            pixel=self.pixel.take(kept),
            source=None if self.source is None else self.source.take(kept),
        )


@dataclass(frozen=True, eq=False)
class ElevationMap:
    """A 2.5-D terrain grid: row index grows with y, column index with x.

    layers: name -> (rows, cols) float32, NaN = unknown, all of one shape, among them "elevation" (m);
    resolution: cell size, m; origin: (x, y) of the lower-left corner of cell [0, 0], m; level: for a map in another
    frame, where the frame `level` of that stamp lies in it.
    """

    stamp: int
    layers: Mapping[str, Array]
    resolution: float
    origin: tuple[float, float]
    frame_id: str
    level: Transform | None = None
    shape: tuple[int, int] = field(init=False)

    def __post_init__(self) -> None:
        layers = {name: np.asarray(layer) for name, layer in self.layers.items()}
        if "elevation" not in layers:
            raise ValueError("ElevationMap has no layer 'elevation'")
        rows, cols = layers["elevation"].shape
        for name, layer in layers.items():
            if layer.shape != (rows, cols) or layer.dtype != np.float32:
                raise ValueError(f"ElevationMap layer '{name}' must be float32 ({rows}, {cols})")
        if not self.resolution > 0:
            raise ValueError(f"ElevationMap.resolution must be positive, not {self.resolution}")
        object.__setattr__(self, "layers", MappingProxyType({n: read_only(layer) for n, layer in layers.items()}))
        object.__setattr__(self, "shape", (rows, cols))


@dataclass(frozen=True, eq=False)
class VoxelMap:
    """Cubes of space that hold points. index: (N, 3) int32, a cube reaching from index * resolution, m, to (index + 1)
    * resolution along x, y, z of `frame_id`; colors: (N, 3) uint8 RGB, mean; count: (N,) int32, points."""

    stamp: int
    index: Array
    colors: Array
    count: Array
    resolution: float
    frame_id: str

    def __post_init__(self) -> None:
        publish(self, "index", (None, 3), np.int32)
        publish(self, "colors", (len(self.index), 3), np.uint8)
        publish(self, "count", (len(self.index),), np.int32)


@dataclass(frozen=True, eq=False)
class NavigationMap:
    """Where the rover may drive. cells: (rows, cols) int8, codes of `Cell`; reason: (rows, cols) uint8, codes of
    `Reason`; grid as in `ElevationMap`."""

    stamp: int
    cells: Array
    reason: Array
    resolution: float
    origin: tuple[float, float]
    frame_id: str

    def __post_init__(self) -> None:
        publish(self, "cells", (None, None), np.int8)
        publish(self, "reason", self.cells.shape, np.uint8)


def _share(first: int, last: int, stamp: int) -> float:
    if not first <= stamp <= last:
        raise ValueError(f"stamp {stamp} is outside [{first}, {last}]")
    return (stamp - first) / (last - first) if last > first else 0.0


def _slerp(start: Array, end: Array, share: float) -> Array:
    """Interpolate between two unit vectors along the great circle."""
    angle = float(np.arctan2(np.linalg.norm(end - start), np.linalg.norm(end + start))) * 2
    if angle < 1e-9:
        return start
    if angle > np.pi - 1e-6:
        raise ValueError("cannot interpolate between opposite directions")
    return (np.sin((1 - share) * angle) * start + np.sin(share * angle) * end) / np.sin(angle)  # type: ignore[no-any-return]
