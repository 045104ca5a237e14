"""Reproject: from a disparity image to points in space (paper section 4, "Depth Estimation").

Every pixel with a disparity becomes a point of the left optical frame. It keeps its colour, its pixel and the standard
deviation of its depth, sigma_Z = Z^2 / (fx * baseline) * sigma_d.
"""

from __future__ import annotations

from dataclasses import dataclass

from stages.cloud.kernels.triangulation import DisparitySigma, triangulate
from stages.data import Disparity, PointCloud, StereoFrame
from stages.matching.intensity import eight_bit
from stages.stage import Stage, check_joined, parameter


@dataclass(frozen=True)
class Reproject(Stage):
    """Triangulates a disparity image.

    The standard deviation of a matched disparity is its own, `Disparity.sigma`. Where the image has none, it falls
    geometrically with the confidence, from `sigma_worst` at 0 to `sigma_best` at 1 (see "Stated sigmas" in
    docs/terrain.md).

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
    sigma_best: float = parameter(0.086, "disparity standard deviation at confidence 1", unit="px", low=1e-3)
    sigma_worst: float = parameter(42.0, "disparity standard deviation at confidence 0", unit="px", low=1e-3)
    sigma_plane: float = parameter(0.75, "disparity standard deviation of a PLANE pixel", unit="px", low=0.0)
    sigma_filled: float = parameter(3.0, "disparity standard deviation of a FILLED pixel", unit="px", low=0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.sigma_best <= self.sigma_worst:
            raise ValueError(
                f"Reproject.sigma_worst must be at least sigma_best ({self.sigma_best} px), not {self.sigma_worst} px"
            )

    def __call__(self, frame: StereoFrame, disparity: Disparity) -> PointCloud:
        """The cloud of `disparity`, with the colours of the left image in 8 bit; it may be empty."""
        camera = disparity.camera or frame.camera
        check_joined(self, frame, disparity)
        sigma_d = DisparitySigma(self.sigma_best, self.sigma_worst, self.sigma_plane, self.sigma_filled)
        colors = eight_bit(frame.left)[0]
        points, rgb, sigma, pixel = triangulate(
            disparity, colors, camera, sigma_d, self.max_depth, self.include_filled, self.max_spacing
        )
        height, width = disparity.pixels.shape
        source = disparity.source.ravel().take(pixel)
        return PointCloud(frame.stamp, points, rgb, sigma, pixel, camera.frame_id, (height, width), source=source)
