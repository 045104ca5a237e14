"""Reproject: from a disparity image to points in space (paper section 4, "Depth Estimation").

Every pixel with a disparity becomes a point of the left optical frame that knows its colour, its pixel and the standard
deviation of its depth, sigma_Z = Z^2 / (fx * baseline) * sigma_d. A filled disparity is a guess about what neither
camera saw: it makes no point unless asked for, and then one with a standard deviation to match.
"""

from __future__ import annotations

from dataclasses import dataclass

from stages.cloud.kernels.triangulation import triangulate
from stages.data import Disparity, PointCloud, StereoFrame
from stages.matching.intensity import eight_bit
from stages.stage import Stage, check_joined, parameter


@dataclass(frozen=True)
class Reproject(Stage):
    """Triangulates a disparity image.

    The standard deviation of a matched disparity falls geometrically with its confidence, `sigma_worst` at 0 and
    `sigma_best` at 1; a pixel of source PLANE has `sigma_plane`, of source FILLED `sigma_filled`. On simulated frames
    68 % of the errors of the matcher's pixels are within it, give or take 8, at every confidence from 0.6 to 1, where
    `rover` has its points (tests/test_terrain_truth.py); below, it is only the same line drawn on.
    """

    max_depth: float = parameter(20.0, "points deeper than this are left out", unit="m", low=0.1)
    include_filled: bool = parameter(False, "whether filled disparities, which no camera measured, become points")
    sigma_best: float = parameter(0.086, "disparity standard deviation at confidence 1", unit="px", low=1e-3)
    sigma_worst: float = parameter(42.0, "disparity standard deviation at confidence 0", unit="px", low=1e-3)
    sigma_plane: float = parameter(0.75, "disparity standard deviation where only a plane knows", unit="px", low=0.0)
    sigma_filled: float = parameter(3.0, "disparity standard deviation of a filled pixel", unit="px", low=0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.sigma_best <= self.sigma_worst:
            raise ValueError(
                f"Reproject.sigma_worst must be at least sigma_best ({self.sigma_best} px), not {self.sigma_worst} px"
            )

    def __call__(self, frame: StereoFrame, disparity: Disparity) -> PointCloud:
        """The cloud of `disparity`, coloured from the left image, stretched to 8 bit; it may be empty."""
        camera = disparity.camera or frame.camera
        check_joined(self, frame, disparity)
        points, colors, sigma, pixel = triangulate(
            disparity.pixels,
            disparity.source,
            disparity.confidence,
            eight_bit(frame.left)[0],
            camera,
            self.max_depth,
            self.include_filled,
            (self.sigma_best, self.sigma_worst, self.sigma_plane, self.sigma_filled),
        )
        shape = (int(disparity.pixels.shape[0]), int(disparity.pixels.shape[1]))
        source = disparity.source.ravel().take(pixel)
        return PointCloud(frame.stamp, points, colors, sigma, pixel, camera.frame_id, shape, source=source)
