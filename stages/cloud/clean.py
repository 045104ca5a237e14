"""Clean: drop far points and outliers (paper section 4, "Outlier Removal & ROI Limitation").

The paper's k-nearest-neighbour filter uses distances in space. On the ground these grow with the square of the range,
so it rejects far ground. Method "organised" looks at neighbours in the image instead and compares inverse depth, whose
steps on a plane are the same near and far. It takes time linear in the points. It also removes small isolated patches,
and patches that would hang in the air or lie under the ground.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flow.contracts import StageError
from stages.cloud.kernels.depth_order import out_of_order
from stages.cloud.kernels.outliers import MAX_SLOPE_RATIO, median_slope, supported, write_depths
from stages.cloud.kernels.patches import connected_patches
from stages.data import Array, PointCloud
from stages.data.arrays import rows_of
from stages.stage import Stage, check_types, parameter

MIN_PATCH_SHARE = 5e-4  # organised: smaller isolated patches, as a share of the cloud, are dropped
KNN_NEIGHBOURS = 20
KNN_MAX_DEVIATIONS = 3.0  # of the mean distance to them, in standard deviations above the cloud's mean
KNN_QUERY = 1 << 14  # points whose nearest neighbours are in memory at once


@dataclass(frozen=True)
class Clean(Stage):
    """Crops a cloud around its camera, then removes outliers.

    The crop is a ball of `max_range` + `margin` around the camera, because the cloud is not levelled yet. With a margin
    of 1 m it contains all ground in range of a camera up to 4 m high. Method "organised" needs at least every 4th pixel
    of a row and of a column.

    Examples
    --------
    >>> points = np.float32([[x / 10, 1, z / 10] for z in range(20, 40) for x in range(-5, 5)])
    >>> n = len(points)
    >>> cloud = PointCloud(0, points, np.zeros((n, 3), np.uint8), np.zeros(n, np.float32), np.arange(n, dtype=np.int32),
    ...                    "camera")
    >>> len(Clean(method="knn", max_range=2.5)(cloud).points)
    136
    """

    method: str = parameter("organised", "outlier removal", choices=("organised", "knn"))
    max_range: float = parameter(8.0, "horizontal range wanted in the map", unit="m", low=0.1, high=200.0)
    margin: float = parameter(1.0, "added to max_range for the crop around the camera", unit="m", low=0.0, high=200.0)

    def __call__(self, cloud: PointCloud) -> PointCloud:
        """The near points of `cloud` that are no outliers, in their order; there may be none."""
        check_types(self, cloud=cloud)
        if cloud.sensor is not None:
            raise StageError(f"Clean: the cloud is in frame '{cloud.frame_id}', not its camera's; Clean precedes Level")
        keep = self._organised(cloud) if self.method == "organised" else self._knn(cloud)
        return cloud.only(keep)

    @property
    def _crop(self) -> float:
        return float(self.max_range + self.margin)

    def _organised(self, cloud: PointCloud) -> Array:
        """Mask of the points kept by their neighbours in the image; points not measured are only cropped."""
        if cloud.shape is None:
            raise StageError("Clean: the cloud has no image shape; set it, or use method: knn")
        measured = cloud.measured
        chosen = np.zeros(len(measured), bool)
        chosen[self._supported(cloud, measured, cloud.shape)] = True
        others = np.flatnonzero(~measured)
        points = rows_of(cloud.points, others)
        near = np.einsum("ij,ij->i", points, points) <= self._crop**2
        chosen[others[near]] = True
        return chosen

    def _supported(self, cloud: PointCloud, measured: Array, shape: tuple[int, int]) -> Array:
        """Indices of the points kept of the measured ones.

        Points beyond the crop count in the order of depth, because the sky begins above them.
        """
        given = np.flatnonzero(measured)
        kept, inverse, tolerance = supported(cloud.points, cloud.sigma, cloud.pixel, given, shape, self._crop)
        far = np.flatnonzero(measured & (cloud.points[:, 2] > self._crop))
        write_depths(cloud.points, cloud.sigma, cloud.pixel, far, math.inf, inverse, tolerance)
        patch, sizes = connected_patches(inverse, tolerance, MAX_SLOPE_RATIO * median_slope(inverse))
        chosen = (sizes >= MIN_PATCH_SHARE * len(kept)) & ~out_of_order(inverse, patch, sizes)
        return np.asarray(kept[chosen.take(patch.ravel().take(cloud.pixel.take(kept)))])

    def _knn(self, cloud: PointCloud) -> Array:
        """Indices of the points kept by the mean distance to their nearest neighbours in space."""
        from scipy.spatial import cKDTree  # takes long to import, and only this method needs it

        squares = np.einsum("ij,ij->i", cloud.points, cloud.points, dtype=np.float64)
        near = np.flatnonzero(squares <= self._crop**2)
        if len(near) <= KNN_NEIGHBOURS:
            return near
        tree, mean = cKDTree(cloud.points[near]), np.empty(len(near))
        for first in range(0, len(near), KNN_QUERY):
            some = slice(first, first + KNN_QUERY)
            distance, _ = tree.query(tree.data[some], k=KNN_NEIGHBOURS + 1, workers=1)
            mean[some] = distance[:, 1:].mean(axis=1)
        kept: Array = near[mean <= mean.mean() + KNN_MAX_DEVIATIONS * mean.std()]
        return kept
