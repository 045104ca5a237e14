"""Voxelise makes the DEM: an elevation map from a levelled cloud (paper section 4, "Digital Elevation Model").

The grid is the same for every frame: a square around the level frame's origin. Each cell keeps the mean, the extremes
and the number of its heights, and the variance of the mean. A cell without measured points stays a hole, and a further
layer marks whether it was occluded or never in view.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.data import LEVEL_FRAME, Array, ElevationMap, PointCloud, Transform
from stages.data.arrays import spanned
from stages.stage import Stage, check_cells, check_level, parameter
from stages.terrain.kernels.cell_gradient import gradient_and_curvature
from stages.terrain.kernels.grid import FIGURES, Grid, cell_percentile, cell_statistics, extent
from stages.terrain.kernels.occlusion import occlusion_ceiling
from stages.terrain.kernels.splats import splat_statistics
from stages.terrain.kernels.staying_points import staying_points
from stages.terrain.match_failure import match_failure

MIN_SPLAT_CELLS = 0.5  # points with a shorter reach are not splatted
MIN_SPLATS = 2  # in a cell without a point of its own
SPLAT_COUNT = 0.5  # the count of such a cell: less than one point
MIN_STAYING_POINTS = 6  # with fewer after a move of one sigma, a cell may rest on the pixels of its neighbours
NOISE_IN_SCATTER = 0.5  # share of the points' noise that their scatter shows, because neighbours err alike
SUMS = [FIGURES.index(name) for name in ("count", "sum", "sum_of_squares", "noise")]


@dataclass(frozen=True)
class Voxelise(Stage):
    """Averages a levelled cloud over the cells of a grid.

    Adds the layers elevation, minimum, maximum, count, variance and common_variance; interpolated, occluded and ceiling
    if the camera is known; filled and unmatched if the cloud contains points that were not measured; percentile_P for
    each of `percentiles`.
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
    correlated_points: float = parameter(4.0, "neighbouring points that share one matching error", low=1.0)
    systematic_share: float = parameter(
        0.8, "share of the points' variance that no averaging removes", low=0.0, high=1.0
    )
    scatter_share: float = parameter(0.2, "share of the scatter beyond slope and noise in the variance", low=0.0)
    curvature_share: float = parameter(0.34, "share of the squared curvature in the variance", low=0.0)
    rim_share: float = parameter(0.15, "share of the squared rise in the variance of a cell beside a hole", low=0.0)
    sight_share: float = parameter(
        1.0, "share of the squared fall of the line of sight within a cell, in the variance of an interpolated cell "
        "beside a hole", low=0.0,
    )  # fmt: skip
    splat_sigmas: float = parameter(
        0.0, "reach of a measured point along its line of sight, in standard deviations of its depth, into cells "
        "without points; 0 = none", low=0.0,
    )  # fmt: skip
    max_splat: float = parameter(
        0.08, "longest reach in depth; behind depth edges, where depth is least certain, the ground is hidden",
        unit="m", low=0.0,
    )  # fmt: skip
    percentiles: tuple[float, ...] = parameter((), "further layers: percentiles of a cell's heights, 50 is the median")
    filled: str = parameter(
        "apart", "PLANE and FILLED points: a layer of their own, or counted as measured", choices=("apart", "counted")
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_cells("Voxelise.max_range", self.max_range, self.resolution, 2)
        if not all(0 <= value <= 100 for value in self.percentiles):
            raise ValueError(f"Voxelise.percentiles must be between 0 and 100, not {self.percentiles}")

    def __call__(self, cloud: PointCloud) -> ElevationMap:
        """The elevation map of a cloud in frame `level`."""
        check_level(self, cloud)
        half = int(np.ceil(self.max_range / self.resolution - 1e-9))
        origin = (-half * self.resolution, -half * self.resolution)
        whole = Grid(self.resolution, origin, (2 * half, 2 * half), self.max_range)
        measured, guessed = self._split(cloud)
        ceiling, sensor = None, cloud.sensor
        if sensor is not None and cloud.shape is not None:
            ceiling = occlusion_ceiling(measured.points, measured.pixel, cloud.shape[1], sensor.translation, whole)
        grid = self._window(cloud, ceiling, whole)
        within = tuple(slice(at, at + cells) for at, cells in zip(grid.first, grid.shape, strict=True))
        layers = self._layers(self._splatted(_statistics(measured, grid), measured, grid), measured, grid)
        empty = layers["count"] == 0
        if ceiling is not None:
            layers["ceiling"] = ceiling = np.where(empty, ceiling[within], np.nan)
            layers["occluded"] = np.where(empty, np.where(np.isfinite(ceiling), 1.0, np.nan), 0.0)
        if guessed is not None:
            figures = _statistics(guessed, grid)
            with np.errstate(invalid="ignore", divide="ignore"):
                layers["filled"] = np.where(empty, figures[:, :, 1] / figures[:, :, 0], np.nan)
            layers["unmatched"] = np.where(empty, match_failure(guessed, grid), np.nan)
        for value in self.percentiles:
            layers[f"percentile_{value:g}"] = cell_percentile(measured.points, value, grid)
        placed = {}
        for name, layer in layers.items():
            placed[name] = np.full(whole.shape, 0 if name == "count" else np.nan, np.float32)
            placed[name][within] = layer
        return ElevationMap(cloud.stamp, placed, self.resolution, origin, LEVEL_FRAME)

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
        reached = splats[:, :, 0] >= MIN_SPLATS
        gained = splats[reached]
        gained[:, SUMS] *= SPLAT_COUNT / gained[:, :1]
        figures[reached] = gained
        return figures

    def _layers(self, figures: Array, cloud: PointCloud, grid: Grid) -> dict[str, Array]:
        count, total, squares, minimum, maximum, noise = (figures[:, :, i] for i in range(len(FIGURES)))
        empty = count == 0
        n = np.where(empty, np.nan, count)
        mean = total / n
        scatter = np.maximum(squares / n - mean * mean, 0.0)
        x, y = grid.middles
        variance = self._variance(n, mean, scatter, noise / n, cloud, x, y)
        more = {}
        if cloud.sensor is not None:
            interpolated = staying_points(cloud.points, cloud.sigma, cloud.sensor, grid) < MIN_STAYING_POINTS
            more["interpolated"] = np.where(empty, np.nan, interpolated)
            fall = self.resolution * _sight_fall(cloud.sensor, mean, x, y)
            variance = variance + np.where(interpolated & _beside_hole(mean), self.sight_share * fall * fall, 0.0)
        return {
            "elevation": mean,
            "minimum": np.where(empty, np.nan, minimum),
            "maximum": np.where(empty, np.nan, maximum),
            "count": count,
            "variance": variance,
            "common_variance": np.where(empty, np.nan, cloud.tilt_sigma**2 * (x * x + y * y)),
            **more,
        }

    def _variance(
        self, n: Array, mean: Array, scatter: Array, noise: Array, cloud: PointCloud, x: Array, y: Array
    ) -> Array:
        """Random variance of the cells' means; n, mean, scatter, noise (of depth): (rows, cols), NaN = empty."""
        east, north, curvature = gradient_and_curvature(mean)
        rise = east * east + north * north
        noise = noise * _lever(cloud, mean, x, y, east / self.resolution, north / self.resolution) ** 2
        uneven = np.maximum(scatter - rise / 12 - NOISE_IN_SCATTER * noise, 0.0)
        return np.asarray(
            noise * (self.systematic_share + np.minimum(1.0, self.correlated_points / n))
            + self.scatter_share * uneven
            + self.curvature_share * curvature * curvature
            + np.where(_beside_hole(mean), self.rim_share * rise, 0.0)
        )


def _statistics(cloud: PointCloud, grid: Grid) -> Array:
    return cell_statistics(cloud.points, cloud.sigma, grid)


def _beside_hole(height: Array) -> Array:
    """Which cells (rows, cols) are empty or have an empty neighbour."""
    known = np.pad(np.isfinite(height), 1)
    in_row = known[:, :-2] & known[:, 1:-1] & known[:, 2:]
    return np.asarray(~(in_row[:-2] & in_row[1:-1] & in_row[2:]))


def _sight_fall(sensor: Transform, height: Array, x: Array, y: Array) -> Array:
    """How far the line of sight to each cell (rows, cols) falls per metre of horizontal distance."""
    eye = sensor.translation
    with np.errstate(divide="ignore"):
        return np.asarray((eye[2] - height) / np.hypot(x - eye[0], y - eye[1]))


def _lever(cloud: PointCloud, height: Array, x: Array, y: Array, east: Array, north: Array) -> Array:
    """Height error over (x, y) per metre of depth error on a slope (east, north); 1 if the camera is not known."""
    if cloud.sensor is None:
        return np.ones_like(height)
    axis, camera = cloud.sensor.rotation[:, 2], cloud.sensor.translation
    dx, dy, dz = x - camera[0], y - camera[1], height - camera[2]
    depth = dx * axis[0] + dy * axis[1] + dz * axis[2]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(depth > 0, (dz - east * dx - north * dy) / depth, 1.0))
