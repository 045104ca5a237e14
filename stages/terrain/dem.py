"""Voxelise makes the DEM: an elevation map from a levelled cloud (paper section 4, "Digital Elevation Model").

The grid is the same for every frame: a square around the level frame's origin. Each cell keeps the mean, the extremes
and the number of its heights, and the variance of the mean. A cell without measured points stays a hole, and a further
layer marks whether it was occluded or never in view.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.data import LEVEL_FRAME, Array, ElevationMap, PointCloud
from stages.data.arrays import spanned
from stages.data.cloud import in_raster_order
from stages.stage import Stage, check_cells, check_level, parameter
from stages.terrain.kernels.cell_layers import VARIANCE, cell_layers
from stages.terrain.kernels.grid import FIGURES, Grid, cell_statistics, extent
from stages.terrain.kernels.occlusion import occlusion_ceiling
from stages.terrain.kernels.splats import splat_statistics
from stages.terrain.kernels.staying_points import staying_points
from stages.terrain.match_failure import match_failure

MIN_SPLAT_CELLS = 0.5  # points with a shorter reach are not splatted
MIN_SPLATS = 2  # in a cell without a point of its own
SPLAT_COUNT = 0.5  # the count of such a cell: less than one point
SUMS = [FIGURES.index(name) for name in ("count", "sum", "sum_of_squares", "noise")]


@dataclass(frozen=True)
class Voxelise(Stage):
    """Averages a levelled cloud over the cells of a grid.

    Adds the layers elevation, minimum, maximum, count, variance and common_variance; interpolated, occluded and ceiling
    if the camera is known; filled and unmatched if the cloud contains points that were not measured.
    docs/terrain.md defines the layers and the model of variance.

    Examples
    --------
    >>> points = np.float32([[1.01, 0.01, 0.1], [1.02, 0.02, 0.3]])
    >>> cloud = PointCloud(0, points, np.zeros((2, 3), np.uint8), np.float32([0.01, 0.01]), np.int32([0, 1]), "level")
    >>> terrain = Voxelise(max_range=2.0)(cloud)
    >>> [round(float(terrain.layers[name][40, 60]), 3) for name in ("elevation", "maximum", "count")]
    [0.2, 0.3, 2.0]
    """

    resolution: float = parameter(0.05, "cell size", unit="m", low=0.005, high=2.0)
    max_range: float = parameter(
        8.0, "horizontal range from the level frame's origin (base_link) kept in the map", unit="m", low=0.1, high=200.0
    )
    splat_sigmas: float = parameter(
        0.0, "reach of a measured point along its line of sight, in standard deviations of its depth, into cells "
        "without points; 0 = none", low=0.0, high=100.0,
    )  # fmt: skip
    max_splat: float = parameter(
        0.08, "longest reach in depth; behind depth edges, where depth is most uncertain, the ground is hidden",
        unit="m", low=0.0, high=200.0,
    )  # fmt: skip
    filled: str = parameter(
        "apart", "PLANE and FILLED points: a layer of their own, or counted as measured", choices=("apart", "counted")
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_cells("Voxelise.max_range", self.max_range, self.resolution, 2)

    def __call__(self, cloud: PointCloud) -> ElevationMap:
        """The elevation map of a cloud in frame `level`."""
        check_level(self, cloud)
        grid, layers = self.in_view(cloud)
        placed = {}
        for name, layer in layers.items():
            placed[name] = np.full(self.whole.shape, 0 if name == "count" else np.nan, np.float32)
            placed[name][grid.within] = layer
        return ElevationMap(cloud.stamp, placed, self.resolution, grid.origin, LEVEL_FRAME)

    @property
    def whole(self) -> Grid:
        """The grid of the map."""
        half = int(np.ceil(self.max_range / self.resolution - 1e-9))
        corner = -half * self.resolution
        return Grid(self.resolution, (corner, corner), (2 * half, 2 * half), self.max_range)

    def in_view(self, cloud: PointCloud) -> tuple[Grid, dict[str, Array]]:
        """The part of the grid that a levelled cloud shows, and its layers there, (rows, cols) float32."""
        whole = self.whole
        measured, guessed = self._split(in_raster_order(cloud))
        ceiling, staying, sensor = None, None, cloud.sensor
        if sensor is not None and cloud.shape is not None:
            ceiling = occlusion_ceiling(measured.points, measured.pixel, cloud.shape[1], sensor.translation, whole)
        grid = self._window(cloud, ceiling, whole)
        figures = _statistics(measured, grid)
        if sensor is not None:
            staying = staying_points(measured.points, measured.sigma, sensor, grid, figures[:, :, 0])
        figures = self._splatted(figures, measured, grid)
        layers = cell_layers(figures, staying, sensor, cloud.tilt_sigma, VARIANCE, grid)
        empty = layers["count"] == 0
        if ceiling is not None:
            layers["ceiling"] = np.where(empty, ceiling[grid.within], np.nan).astype(np.float32)
            hidden = np.isfinite(layers["ceiling"])
            layers["occluded"] = np.where(hidden, 1, np.where(empty, np.nan, 0)).astype(np.float32)
        if guessed is not None:
            figures = _statistics(guessed, grid)
            with np.errstate(invalid="ignore", divide="ignore"):
                layers["filled"] = np.where(empty, figures[:, :, 1] / figures[:, :, 0], np.nan).astype(np.float32)
            layers["unmatched"] = np.where(empty, match_failure(guessed, grid), np.nan).astype(np.float32)
        return grid, layers

    def _window(self, cloud: PointCloud, ceiling: Array | None, whole: Grid) -> Grid:
        """The part of the grid that contains the points, their splats and the lines of sight over empty cells."""
        bounds = [extent(cloud.points, whole).tolist()]
        if ceiling is not None:
            seen = np.isfinite(ceiling)
            rows, cols = spanned(seen)
            bounds += [[rows.start, cols.start, rows.stop, cols.stop]] if seen.any() else []
        margin = 2 + int(2 * self.max_splat / self.resolution)
        first = np.maximum(np.min(bounds, axis=0)[:2] - margin, 0)
        stop = np.maximum(np.minimum(np.max(bounds, axis=0)[2:] + margin, whole.shape), first + 1)
        return whole._replace(shape=tuple((stop - first).tolist()), first=tuple(first.tolist()))

    def _split(self, cloud: PointCloud) -> tuple[PointCloud, PointCloud | None]:
        """The points that count as measured, and the others if there are any."""
        measured = cloud.measured
        if self.filled == "counted" or measured.all():
            return cloud, None
        return cloud.only(measured), cloud.only(~measured)

    def _splatted(self, figures: Array, cloud: PointCloud, grid: Grid) -> Array:
        """The figures of `cell_statistics`, with those of splats in empty cells that receive enough of them."""
        sensor = cloud.sensor
        min_reach = MIN_SPLAT_CELLS * self.resolution
        if sensor is None or self.splat_sigmas == 0 or self.max_splat < min_reach:
            return figures
        reach = self.splat_sigmas, min_reach, self.max_splat
        splats = splat_statistics(cloud.points, cloud.sigma, sensor, reach, grid, figures[:, :, 0] == 0)
        reached = np.flatnonzero(splats[:, :, 0] >= MIN_SPLATS)
        gained = splats.reshape(-1, len(FIGURES)).take(reached, axis=0)
        gained[:, SUMS] *= SPLAT_COUNT / gained[:, :1]
        figures.reshape(-1, len(FIGURES))[reached] = gained
        return figures


def _statistics(cloud: PointCloud, grid: Grid) -> Array:
    return cell_statistics(cloud.points, cloud.sigma, grid)
