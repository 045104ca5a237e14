"""The data that flows: frozen dataclasses, one per kind of thing a stage takes or makes.

Conventions, everywhere: `stamp` is int nanoseconds of the log's clock; lengths are metres, angles radians; arrays are
read-only once published; unknown is NaN (or -1 where the type says so), never a number that could be a value.

Camera frame: left optical frame, x right, y down, z forward. Level frame: z up against gravity, x the rover's
horizontal heading, y left. What says where things are and how they move stands in `stages.data.motion`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from types import MappingProxyType
from typing import cast

import numpy as np

from stages.data.arrays import Array as Array
from stages.data.arrays import check_resolution, publish, publish_image, publish_stamp, publish_vector, read_only
from stages.data.motion import CameraMotion as CameraMotion
from stages.data.motion import Mount as Mount
from stages.data.motion import Pose as Pose
from stages.data.motion import Tilt as Tilt
from stages.data.motion import TiltHealth as TiltHealth
from stages.data.motion import Transform as Transform
from stages.data.tiles import Tiles as Tiles

LEVEL_FRAME = "level"
ALIKE = 1e-3  # of a focal length or of cy, by which those of a rectified pair may differ: a pixel at 1000 px
_OPENCV = (0, 4, 5, 8, 12, 14)  # coefficients; how many there are tells the model, whatever a driver calls it
DISTORTION_SIZES = {"plumb_bob": _OPENCV, "rational_polynomial": _OPENCV, "equidistant": (4,)}


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

    @property
    def turns(self) -> bool:
        """Whether R is a rotation."""
        return bool(np.allclose(self.r @ self.r.T, np.eye(3), atol=1e-3) and np.linalg.det(self.r) > 0)

    def unlike(self, right: CameraModel) -> str:
        """By what the projections of two cameras differ that a rectified pair has in common; empty where by nothing."""
        shared = {"fx": (0, 0), "fy": (1, 1), "cy": (1, 2)}
        pairs = {name: (float(self.p[place]), float(right.p[place])) for name, place in shared.items()}
        differing = [name for name, pair in pairs.items() if not math.isclose(*pair, rel_tol=ALIKE)]
        return " and ".join(f"{name} is {pairs[name][0]:.6g} and {pairs[name][1]:.6g} px" for name in differing)

    @property
    def unusable(self) -> str:
        """Why a raw image cannot be rectified with it, empty where it can."""
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
        """The rectified camera that two CameraInfo messages describe through their projection matrices.

        Raises ValueError where these are not those of a rectified pair.
        """
        if differing := left.unlike(right):
            raise ValueError(f"the cameras' P are not those of a rectified pair: {differing}")
        return cls(
            fx=float(left.p[0, 0]), fy=float(left.p[1, 1]), cx=float(left.p[0, 2]), cy=float(left.p[1, 2]),
            baseline=float(left.p[0, 3] / left.p[0, 0] - right.p[0, 3] / right.p[0, 0]),
            width=left.width, height=left.height, cx_right=float(right.p[0, 2]), frame_id=frame_id,
            raw=None if rectified else (left, right),
        )  # fmt: skip

    @property
    def doubts(self) -> tuple[str, ...]:
        """What the calibration says that hardly any camera has, a sentence each: it may be of another image size."""
        size, said = f"{self.width}x{self.height}", []
        for name, extent in (("cx", self.width), ("cx_right", self.width), ("cy", self.height)):
            if not 0.2 * extent <= getattr(self, name) <= 0.8 * extent:
                outer = f"{name} of {getattr(self, name):g} px lies in the outer fifth of {size} images"
                said.append(f"{outer}: check that the calibration is for this size")
        if self.baseline > 5:
            said.append(f"the baseline is {self.baseline:g} m: check that it is given in metres")
        return tuple(said)


@dataclass(frozen=True, eq=False)
class CameraImage:
    """One image of one camera, with its calibration.

    pixels: uint8 or uint16, (H, W) or (H, W, 3) RGB; frame_id: the camera's optical frame; rectified: whether `pixels`
    are rectified already.
    """

    stamp: int
    pixels: Array
    model: CameraModel
    frame_id: str
    rectified: bool

    def __post_init__(self) -> None:
        publish_stamp(self)
        publish_image(self, "pixels")

    def pair_with(self, right: CameraImage) -> StereoFrame:
        """The stereo frame of this (left) image and its right partner; it carries the left image's stamp."""
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
        publish_stamp(self)
        publish_image(self, "left")
        publish_image(self, "right")
        if self.left.shape != self.right.shape:
            raise ValueError(f"StereoFrame: left is {self.left.shape}, right is {self.right.shape}")
        if self.left.dtype != self.right.dtype:
            raise ValueError(f"StereoFrame: left is {self.left.dtype}, right is {self.right.dtype}; record both alike")
        if self.left.shape[:2] != (self.camera.height, self.camera.width):
            raise ValueError(
                f"StereoFrame: images are {self.left.shape[1]}x{self.left.shape[0]}, "
                f"the calibration is for {self.camera.width}x{self.camera.height}"
            )


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
        publish_stamp(self)
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
        publish_stamp(self)
        publish(self, "points", (None, 3), np.float32)
        n = len(self.points)
        publish(self, "colors", (n, 3), np.uint8)
        publish(self, "sigma", (n,), np.float32)
        publish(self, "pixel", (n,), np.int32)
        if self.source is not None:
            publish(self, "source", (n,), np.uint8)

    @property
    def measured(self) -> Array:
        """Which points were matched at their own pixel, (N,) bool: the evidence."""
        return np.ones(len(self.points), bool) if self.source is None else np.equal(self.source, Source.MEASURED)

    def only(self, kept: Array) -> PointCloud:
        """The points of the indices (n,) int or the mask (N,) bool `kept`, in that order."""
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
    frame, where the frame `level` of that stamp lies in it; epoch: for a map of many frames, the stamp, ns, from which
    its layers "first" and "last" count seconds.
    """

    stamp: int
    layers: Mapping[str, Array]
    resolution: float
    origin: tuple[float, float]
    frame_id: str
    level: Transform | None = None
    epoch: int | None = None
    shape: tuple[int, int] = field(init=False)

    def __post_init__(self) -> None:
        publish_stamp(self)
        check_resolution(self)
        layers = {name: np.asarray(layer) for name, layer in self.layers.items()}
        if "elevation" not in layers:
            raise ValueError("ElevationMap has no layer 'elevation'")
        rows, cols = layers["elevation"].shape
        for name, layer in layers.items():
            if layer.shape != (rows, cols) or layer.dtype != np.float32:
                raise ValueError(f"ElevationMap layer '{name}' must be float32 ({rows}, {cols})")
        object.__setattr__(self, "layers", MappingProxyType({n: read_only(layer) for n, layer in layers.items()}))
        object.__setattr__(self, "shape", (rows, cols))


@dataclass(frozen=True, eq=False)
class VoxelMap:
    """Cubes of space that hold points.

    index: (N, 3) int32, a cube reaching from index * resolution, m, to (index + 1) * resolution along x, y, z of
    `frame_id`; colors: (N, 3) uint8 RGB, mean; count: (N,) int32, points.
    """

    stamp: int
    index: Array
    colors: Array
    count: Array
    resolution: float
    frame_id: str

    def __post_init__(self) -> None:
        publish_stamp(self)
        check_resolution(self)
        publish(self, "index", (None, 3), np.int32)
        publish(self, "colors", (len(self.index), 3), np.uint8)
        publish(self, "count", (len(self.index),), np.int32)


@dataclass(frozen=True, eq=False)
class NavigationMap:
    """Where the rover may drive.

    cells: (rows, cols) int8, codes of `Cell`; reason: (rows, cols) uint8, codes of `Reason`; resolution, m, and origin,
    m, as in `ElevationMap`.
    """

    stamp: int
    cells: Array
    reason: Array
    resolution: float
    origin: tuple[float, float]
    frame_id: str

    def __post_init__(self) -> None:
        publish_stamp(self)
        check_resolution(self)
        publish(self, "cells", (None, None), np.int8)
        publish(self, "reason", self.cells.shape, np.uint8)


@dataclass(frozen=True)
class MatchHealth:
    """How much of a frame is matched: shares of all pixels and of those of the nearest ground in view."""

    stamp: int
    all: float
    near: float

    def __post_init__(self) -> None:
        publish_stamp(self)
