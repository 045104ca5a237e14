"""Clean: drop far points and outliers (paper section 4, "Outlier Removal & ROI Limitation").

The paper's k-nearest-neighbour filter measures distances in space, which on the ground grow with the square of the
range: it mistakes distance for error. The default here asks the image instead: a point stays where enough of its
neighbours in the image see the same surface, judged in inverse depth, in which near and far ground look alike. It takes
time linear in the points. Patches that support themselves but touch nothing else go as well where they are small, or
hang in the air or lie under the ground. The paper's filter remains as method "knn".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from flow.contracts import StageError
from stages.cloud.kernels.depth_order import out_of_order
from stages.cloud.kernels.outliers import supported, usual_slope
from stages.cloud.kernels.patches import depth_images, patches
from stages.data import Array, PointCloud
from stages.stage import Stage, parameter


@dataclass(frozen=True)
class Clean(Stage):
    """Crops a cloud about its camera, then removes outliers.

    The crop comes first, so that the far field has no say in what is an outlier near by. It is a ball about the camera
    of `max_range` + `margin`: before levelling nobody knows what is horizontal, and with the margin it holds all ground
    within the region for any camera up to 4 m above it. Voxelise cuts the exact circle.

    method "organised" needs at least every 4th pixel of a row and of a column; sparser clouds have no neighbours.
    """

    method: str = parameter("organised", "outlier removal", choices=("organised", "knn"))
    max_range: float = parameter(8.0, "horizontal range wanted in the map", unit="m", low=0.1, high=200.0)
    margin: float = parameter(1.0, "added to region to crop by distance from the camera", unit="m", low=0.0)
    max_deviations: float = parameter(
        3.0, "organised: difference of neighbours that noise may explain, in standard deviations; knn: threshold above "
        "the mean distance, in standard deviations of it", low=0.0,
    )  # fmt: skip
    max_slope_ratio: float = parameter(
        2.0, "organised: steepest slope of a surface, in multiples of the ground's", low=0.0
    )
    min_agreeing_share: float = parameter(
        0.3, "organised: part of the 32 neighbours that must agree", low=0.0, high=1.0
    )
    min_neighbours: int = parameter(
        4, "organised: neighbours without which a point cannot be judged, and goes", low=1, high=32
    )
    min_patch_share: float = parameter(
        5e-4, "organised: part of the cloud below which a patch with nothing around it at its depth goes",
        low=0.0, high=1.0,
    )  # fmt: skip
    knn_neighbours: int = parameter(20, "knn: number of nearest neighbours", low=1)

    def __call__(self, cloud: PointCloud) -> PointCloud:
        """The points of `cloud`, in their order, that are near and no outliers; there may be none."""
        if cloud.sensor is not None:
            raise StageError(f"Clean: the cloud is in frame '{cloud.frame_id}', not its camera's; Clean precedes Level")
        keep = self._organised(cloud) if self.method == "organised" else self._knn(cloud)
        return cloud.only(keep)

    def _organised(self, cloud: PointCloud) -> Array:
        """Indices of the points that stay, by their neighbours in the image.

        Those that are not measured are no evidence, so they support nobody and are cropped only.
        """
        if cloud.shape is None:
            raise StageError("Clean: the cloud does not say its image's shape; set it, or use method: knn")
        measured = np.flatnonzero(cloud.measured)
        square = np.einsum("ij,ij->i", cloud.points, cloud.points)
        kept = ~cloud.measured & (cloud.points[:, 2] > 0) & (square <= (self.max_range + self.margin) ** 2)
        kept[measured[self._supported(cloud.only(measured), cloud.shape)]] = True
        return np.flatnonzero(kept)

    def _supported(self, cloud: PointCloud, shape: tuple[int, int]) -> Array:
        """Indices of the points that stay of a cloud all of whose points are measured."""
        if len(cloud.pixel) and not 0 <= cloud.pixel.min() <= cloud.pixel.max() < shape[0] * shape[1]:
            raise StageError(f"Clean: the cloud has pixel indices outside its image of shape {shape}")
        kept = np.flatnonzero(
            supported(
                cloud.points,
                cloud.sigma,
                cloud.pixel,
                shape,
                self.max_range + self.margin,
                self.max_deviations,
                self.max_slope_ratio,
                self.min_agreeing_share,
                self.min_neighbours,
            )
        )
        return kept[self._whole(cloud, kept, shape)]

    def _whole(self, cloud: PointCloud, kept: Array, shape: tuple[int, int]) -> Array:
        """Which of the points that were kept are of a patch that is large enough and in order, (len(kept),) bool.

        What lies beyond the crop bears witness: the sky begins above it.
        """
        far = np.flatnonzero(cloud.points[:, 2] > self.max_range + self.margin)
        seen = np.concatenate([kept, far])
        inverse, tolerance = depth_images(cloud.points, cloud.sigma, cloud.pixel, seen, shape, self.max_deviations)
        patch = patches(inverse, tolerance, self.max_slope_ratio * usual_slope(inverse))
        sizes = np.bincount(patch.ravel() + 1, minlength=patch.size + 1)
        place = cloud.pixel.take(kept)
        large = sizes.take(patch.ravel().take(place) + 1) >= self.min_patch_share * len(kept)
        return np.asarray(large & ~out_of_order(inverse, patch).ravel().take(place))

    def _knn(self, cloud: PointCloud) -> Array:
        """Indices of the points that stay, by the mean distance to their nearest neighbours in space."""
        points = cloud.points.astype(np.float64)
        near = np.flatnonzero(np.einsum("ij,ij->i", points, points) <= (self.max_range + self.margin) ** 2)
        if len(near) <= self.knn_neighbours:
            return near
        distance, _ = cKDTree(points[near]).query(points[near], k=self.knn_neighbours + 1, workers=1)
        mean = distance[:, 1:].mean(axis=1)
        kept: Array = near[mean <= mean.mean() + self.max_deviations * mean.std()]
        return kept
