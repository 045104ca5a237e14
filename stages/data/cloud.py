"""Point clouds and voxels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stages.data.arrays import Array, check_resolution, publish, publish_stamp
from stages.data.disparity import PixelOrigin
from stages.data.motion import Transform


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points of the left image in space.

    points: (N, 3) float32, m, in `frame_id`; colors: (N, 3) uint8 RGB; sigma: (N,) float32, depth standard deviation,
    m; pixel: (N,) int32, index into the flattened left image; sensor: where the camera is in `frame_id`, None where
    the cloud is still in the camera's own frame; shape: (H, W) of the left image that `pixel` indexes, where known;
    source: (N,) uint8, codes of `PixelOrigin`, None where all points are measured; tilt_sigma: standard deviation of
    the direction of up that the cloud was levelled with, about each horizontal axis, rad.
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
        return np.ones(len(self.points), bool) if self.source is None else np.equal(self.source, PixelOrigin.MEASURED)

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
