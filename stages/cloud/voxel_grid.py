"""VoxelGrid: the cubes of space that hold measured points, with their number and mean colour.

An elevation map keeps one height a cell; here an overhang, a wall and a floater remain to be seen. For the timeline:
nothing is decided on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.cloud.kernels.voxels import voxel_means
from stages.data import LEVEL_FRAME, PointCloud, VoxelMap
from stages.stage import Stage, check_cells, check_level, parameter


@dataclass(frozen=True)
class VoxelGrid(Stage):
    """Sorts the measured points of a levelled cloud into cubes; what refinement made up is left out."""

    resolution: float = parameter(0.05, "edge of a cube", unit="m", low=0.005, high=2.0)
    max_range: float = parameter(8.0, "horizontal range from the level frame's origin", unit="m", low=0.1, high=200.0)
    min_points: int = parameter(1, "points without which a cube is left out", low=1)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_cells("VoxelGrid.max_range", self.max_range, self.resolution, 2)

    def __call__(self, cloud: PointCloud) -> VoxelMap:
        """The cubes of a cloud in frame `level`; there may be none."""
        check_level(self, cloud)
        x, y = cloud.points[:, 0], cloud.points[:, 1]
        inside = cloud.measured & np.isfinite(cloud.points[:, 2]) & (x * x + y * y <= self.max_range**2)
        near = cloud.only(inside)
        index, count, colors = voxel_means(near.points, near.colors, self.resolution)
        kept = count >= self.min_points
        return VoxelMap(cloud.stamp, index[kept], colors[kept], count[kept], self.resolution, LEVEL_FRAME)
