"""Reproject: from a disparity image to points in space (paper section 4, "Depth Estimation").

Every pixel with a disparity becomes a point of the left optical frame. It keeps its colour, its pixel and the standard
deviation of its depth, sigma_Z = Z^2 / (fx * baseline) * sigma_d.
"""

from __future__ import annotations

from dataclasses import dataclass

from stages.cloud.kernels.triangulation import triangulate
from stages.data import Disparity, PointCloud, StereoFrame
from stages.matching.intensity import eight_bit
from stages.stage import Stage, check_joined, check_same_time, parameter


@dataclass(frozen=True)
class Reproject(Stage):
    """Triangulates a disparity image.

    The standard deviation of a matched disparity is its own, `Disparity.sigma`. Where it has none, it falls with
    the confidence (see "Stated sigmas" in docs/terrain.md).

    Examples
    --------
    >>> import numpy as np
    >>> from stages import PixelOrigin, StereoCamera
    >>> camera = StereoCamera(100.0, 100.0, 2.0, 0.5, baseline=0.2, width=4, height=1)
    >>> image, known = np.zeros((1, 4), np.uint8), np.full((1, 4), PixelOrigin.MEASURED, np.uint8)
    >>> disparity = Disparity(0, np.float32([[4, 5, 10, 20]]), known, np.ones((1, 4), np.float32))
    >>> Reproject()(StereoFrame(0, image, image, camera), disparity).points[:, 2].tolist()
    [5.0, 4.0, 2.0, 1.0]
    """

    max_depth: float = parameter(20.0, "points deeper than this are left out", unit="m", low=0.1)
    include_filled: bool = parameter(False, "whether filled disparities, which no camera measured, become points")
    max_spacing: float = parameter(
        0.0,
        "near points are thinned to every 2nd or 4th row, no farther apart than this, and to every 2nd or 4th column, "
        "no farther apart than twice this; 0: all points",
        unit="m", low=0.0, high=1.0,
    )  # fmt: skip

    def __call__(self, frame: StereoFrame, disparity: Disparity) -> PointCloud:
        """The cloud of `disparity`, with the colours of the left image in 8 bit; it may be empty."""
        check_joined(self, frame, disparity)
        check_same_time(self, frame=frame.stamp, disparity=disparity.stamp)
        camera = disparity.camera or frame.camera
        colors = eight_bit(frame.left)[0]
        points, rgb, sigma, pixel = triangulate(
            disparity, colors, camera, self.max_depth, self.include_filled, self.max_spacing
        )
        height, width = disparity.pixels.shape
        source = disparity.source.ravel().take(pixel)
        return PointCloud(frame.stamp, points, rgb, sigma, pixel, camera.frame_id, (height, width), source=source)
