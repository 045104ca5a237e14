"""VoxelGrid: occupied voxels with the number and mean colour of their points.

An elevation map keeps one height per cell. The voxels also show overhangs, walls and floaters on the timeline. No
decision uses them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flow.contracts import StageError
from stages.cloud.kernels.voxels import voxel_means
from stages.data import LEVEL_FRAME, PointCloud, VoxelMap
from stages.data.arrays import rows_of
from stages.stage import MAX_CELLS, Stage, check_cells, check_level, parameter


@dataclass(frozen=True)
class VoxelGrid(Stage):
    """Sorts the measured points of a levelled cloud into voxels.

    Examples
    --------
    >>> points, colors = np.float32([[1.01, 1.01, 0.01], [1.02, 1.02, 0.02]]), np.uint8([[10, 20, 30], [20, 30, 41]])
    >>> cloud = PointCloud(0, points, colors, np.zeros(2, np.float32), np.int32([0, 1]), "level")
    >>> voxels = VoxelGrid()(cloud)
    >>> voxels.index.tolist(), voxels.colors.tolist(), voxels.count.tolist()
    ([[20, 20, 0]], [[15, 25, 35]], [2])
    """

    resolution: float = parameter(0.05, "edge of a voxel", unit="m", low=0.005, high=2.0)
    max_range: float = parameter(
        8.0, "horizontal range from the level frame's origin (base_link)", unit="m", low=0.1, high=200.0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_cells("VoxelGrid.max_range", self.max_range, self.resolution, 2)

    def __call__(self, cloud: PointCloud) -> VoxelMap:
        """The voxels of a cloud in frame `level`; there may be none."""
        check_level(self, cloud)
        x, y = cloud.points[:, 0], cloud.points[:, 1]
        inside = cloud.measured & np.isfinite(cloud.points[:, 2]) & (x * x + y * y <= self.max_range**2)
        points, colors = rows_of(cloud.points, inside), rows_of(cloud.colors, inside)
        height = float(np.abs(points[:, 2]).max(initial=0))
        if height > MAX_CELLS * self.resolution:
            raise StageError(
                f"VoxelGrid: a point is {height:g} m above or below the origin; the limit is {MAX_CELLS} voxels of "
                f"{self.resolution:g} m; remove outliers with stages.Clean"
            )
        index, count, colors = voxel_means(points, colors, self.resolution)
        return VoxelMap(cloud.stamp, index, colors, count, self.resolution, LEVEL_FRAME)
