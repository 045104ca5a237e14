"""Voxelise: from a levelled cloud to an elevation map (paper section 4, "Digital Elevation Model").

The grid is the same for every frame: a square about the level frame's origin, wide enough for the region. Each cell
keeps the mean of its heights, as the paper has it, with their extremes, their number and the variance of that mean.
A cell without points stays a hole.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.data import LEVEL_FRAME, Array, ElevationMap, PointCloud
from stages.kernels.grid import FIGURES, cell_statistics
from stages.stage import Stage, parameter


@dataclass(frozen=True)
class Voxelise(Stage):
    """Averages a levelled cloud over the cells of a grid.

    Layers: elevation (mean), minimum, maximum (m), count (points), variance (m^2). Cells without points have count 0
    and NaN elsewhere.

    variance is that of the mean against the cell's true mean height, from what is random within a frame:
    (s^2 + q) / max(1, count / correlated), with s^2 the scatter of the heights in the cell, q the mean of the squared
    vertical part of the points' depth noise, and `correlated` the number of neighbouring points that share one matching
    error. Tilt and calibration errors move a whole frame at once and are no part of it.
    """

    resolution: float = parameter(0.05, "cell size", unit="m", low=0.005, high=2.0)
    region: float = parameter(8.0, "horizontal range from the level frame's origin kept in the map", unit="m", low=0.1)
    correlated: float = parameter(25.0, "neighbouring points that share one matching error (5 x 5 pixels)", low=1.0)

    def __call__(self, cloud: PointCloud) -> ElevationMap:
        """The elevation map of a cloud in frame `level`."""
        if cloud.frame_id != LEVEL_FRAME:
            raise ValueError(f"Voxelise: the cloud is in frame '{cloud.frame_id}', not '{LEVEL_FRAME}'; it needs Level")
        half = int(np.ceil(self.region / self.resolution - 1e-9))
        origin = (-half * self.resolution, -half * self.resolution)
        figures = cell_statistics(
            cloud.points, cloud.sigma, _lever(cloud), self.resolution, origin, 2 * half, self.region
        )  # fmt: skip
        return ElevationMap(cloud.stamp, self._layers(figures), self.resolution, origin, LEVEL_FRAME)

    def _layers(self, figures: Array) -> dict[str, Array]:
        count, total, squares, minimum, maximum, noise = (figures[:, :, i] for i in range(len(FIGURES)))
        empty = count == 0
        n = np.where(empty, np.nan, count)
        mean = total / n
        scatter = np.maximum(squares / n - mean * mean, 0.0)
        variance = (scatter + noise / n) / np.maximum(1.0, n / self.correlated)
        layers = {
            "elevation": mean,
            "minimum": np.where(empty, np.nan, minimum),
            "maximum": np.where(empty, np.nan, maximum),
            "count": count,
            "variance": variance,
        }
        return {name: layer.astype(np.float32) for name, layer in layers.items()}


def _lever(cloud: PointCloud) -> Array:
    """Position and viewing axis of the sensor, as `cell_statistics` wants them."""
    if cloud.sensor is None:
        return np.zeros(7)
    return np.concatenate([cloud.sensor.translation, cloud.sensor.rotation[:, 2], [1.0]])
