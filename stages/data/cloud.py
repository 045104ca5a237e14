"""Point clouds and voxels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from numbers import Integral
from typing import Any

import numpy as np

from flow.contracts import StageError
from stages.data.arrays import Array, check_resolution, publish, publish_plain, rows_of
from stages.data.motion import Transform
from stages.data.pixel_validity import PixelOrigin


@dataclass(frozen=True, eq=False)
class PointCloud:
    """3-D points of the left image.

    Parameters
    ----------
    stamp : int
        Nanoseconds of the log's clock.
    points : (N, 3) float32
        Metres, in `frame_id`.
    colors : (N, 3) uint8
        RGB.
    sigma : (N,) float32
        Standard deviation of the depth, m.
    pixel : (N,) int32
        Index into the flattened left image.
    shape : (H, W), optional
        Size of that image.
    sensor : Transform, optional
        Pose of the camera in `frame_id`; None while the cloud is in the camera's own frame.
    source : (N,) uint8, optional
        Codes of `PixelOrigin`; None if all points are measured.
    tilt_sigma : float
        Standard deviation, rad, of the up direction that levelled the cloud, about each horizontal axis.

    Examples
    --------
    >>> cloud = PointCloud(0, np.float32([[0, 0, 2], [1, 0, 3]]), np.zeros((2, 3), np.uint8),
    ...                    np.float32([0.01, 0.02]), np.int32([5, 6]), "camera")
    >>> cloud.only(cloud.sigma < 0.015).points.tolist()
    [[0.0, 0.0, 2.0]]
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
        publish_plain(self)
        publish(self, "points", (None, 3), np.float32)
        n = len(self.points)
        publish(self, "colors", (n, 3), np.uint8)
        publish(self, "sigma", (n,), np.float32)
        publish(self, "pixel", (n,), np.int32)
        if self.source is not None:
            publish(self, "source", (n,), np.uint8)
        if self.shape is not None:
            self._check_pixels(self.shape)

    def _check_pixels(self, shape: tuple[int, int]) -> None:
        """Raise StageError for a shape that is none of an image, and for a pixel outside the image."""
        if len(shape) != 2 or not all(isinstance(extent, Integral) and extent > 0 for extent in shape):
            raise StageError(f"PointCloud.shape must be (rows, columns), at least (1, 1), not {shape}")
        if len(self.pixel) and not 0 <= self.pixel.min() <= self.pixel.max() < shape[0] * shape[1]:
            raise StageError(f"PointCloud.pixel has indices outside an image of shape {shape}")

    @property
    def measured(self) -> Array:
        """Mask (N,) bool of the points that were matched at their own pixel."""
        return np.ones(len(self.points), bool) if self.source is None else np.equal(self.source, PixelOrigin.MEASURED)

    def only(self, kept: Array) -> PointCloud:
        """The points of a mask (N,) bool or of indices (n,) int, in that order."""
        fields: dict[str, Any] = {}
        for name in ("points", "colors", "sigma", "pixel", "source"):
            values = getattr(self, name)
            fields[name] = None if values is None else rows_of(values, kept)
        return replace(self, **fields)


def in_raster_order(cloud: PointCloud) -> PointCloud:
    """The cloud with its points in the order of their pixels, as an image has them."""
    if (cloud.pixel[1:] >= cloud.pixel[:-1]).all():
        return cloud
    return cloud.only(np.argsort(cloud.pixel, kind="stable"))


@dataclass(frozen=True, eq=False)
class VoxelMap:
    """Occupied voxels.

    Parameters
    ----------
    index : (N, 3) int32
        A voxel spans index * resolution to (index + 1) * resolution, m, along x, y, z of `frame_id`.
    colors : (N, 3) uint8
        Mean RGB of its points.
    count : (N,) int32
        Number of its points.
    """

    stamp: int
    index: Array
    colors: Array
    count: Array
    resolution: float
    frame_id: str

    def __post_init__(self) -> None:
        publish_plain(self)
        check_resolution(self)
        publish(self, "index", (None, 3), np.int32)
        publish(self, "colors", (len(self.index), 3), np.uint8)
        publish(self, "count", (len(self.index),), np.int32)
