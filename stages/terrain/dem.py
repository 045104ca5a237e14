"""Voxelise: from a levelled cloud to an elevation map (paper section 4, "Digital Elevation Model").

The grid is the same for every frame: a square about the level frame's origin, wide enough for the region. Each cell
keeps the mean of its heights, as the paper has it, with their extremes, their number and how sure the mean is. A cell
without measured points stays a hole, and a layer of its own says whether it was hidden or never looked at.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_erosion

from stages.data import LEVEL_FRAME, Array, ElevationMap, PointCloud
from stages.stage import Stage, check_cells, check_level, parameter
from stages.terrain.kernels.cell_gradient import gradient_and_curvature
from stages.terrain.kernels.grid import FIGURES, cell_percentile, cell_statistics
from stages.terrain.kernels.occlusion import lowest_sight
from stages.terrain.kernels.splat_along_ray import laid_along_sight

Grid = tuple[float, tuple[float, float], int, float]  # resolution, origin, rows and columns, region
FINEST = 0.5  # of a cell, below which a point's reach is not worth following
WITNESSES = 2  # places along lines of sight that a cell without a point of its own must have
REACHED = 0.5  # the count of such a cell: less than a point
SHOWING = 0.5  # share of the points' noise that shows in their scatter: neighbours err alike
SUMS = [FIGURES.index(name) for name in ("count", "sum", "sum_of_squares", "noise")]


@dataclass(frozen=True)
class Voxelise(Stage):
    """Averages a levelled cloud over the cells of a grid.

    Layers:
    - elevation (mean), minimum, maximum, m, and count, of the measured points; without any, count is 0, the others NaN.
      With `splat_sigmas`, an empty cell into which at least 2 places fall where measured points might lie as well, 4
      of them along each line of sight, has the mean of these, and a count of 0.5: it is known, but no point says so;
    - variance, m^2: of the mean against the cell's true mean height, from what is random within a frame;
    - common_variance, m^2: from the tilt's uncertainty, which moves a whole frame at once, so that neither many points
      nor many cells average it out: (tilt_sigma * range)^2;
    - occluded: 1 in empty cells between measured ground and measured ground, or behind it, as the camera looks: hidden,
      or not matched; 0 in measured cells; NaN in cells never looked at; absent where the camera is not known;
    - ceiling, m: in occluded cells, the lowest line of sight over them, below which what is hidden lies;
    - filled, m: mean of points that are not measured, of sources PLANE and FILLED, in cells without measured ones; only
      where the cloud has such points;
    - percentile_P for each P in `percentiles`, m.

    The random variance of a mean of n points is tails * noise * (systematic + min(1, correlated / n)) + shape: noise is
    the mean square of what the points' depth sigmas do to a height, on a slope more or less than on the level, and the
    mean of points that share one error is as sure as one of them; shape is what the mean of some points misses of an
    uneven cell, by its scatter beyond the slope's and the noise's and by its height off its neighbours; a cell beside
    an empty one, of which they may show one side, misses more (`rim_share`). Errors have longer tails than a
    Gaussian's: where 92 to 94 % are within two such sigmas, 69 to 73 % are within one.
    """

    resolution: float = parameter(0.05, "cell size", unit="m", low=0.005, high=2.0)
    max_range: float = parameter(
        8.0, "horizontal range from the level frame's origin kept in the map", unit="m", low=0.1, high=200.0
    )
    tail_factor: float = parameter(
        1.2, "variance of a point over the square of its sigma, within which 68 % are", low=0.0
    )
    correlated_points: float = parameter(12.0, "neighbouring points that share one matching error", low=1.0)
    systematic_share: float = parameter(
        0.06, "share of the points' variance that no averaging removes", low=0.0, high=1.0
    )
    scatter_share: float = parameter(0.15, "share of the scatter beyond slope and noise in the variance", low=0.0)
    curvature_share: float = parameter(
        0.4, "share of the square of the height off the neighbours in the variance", low=0.0
    )
    rim_share: float = parameter(
        0.12, "share of the square of its rise in the variance of a cell beside an empty one", low=0.0
    )
    splat_sigmas: float = parameter(
        0.0, "how far along its line of sight, in standard deviations of its depth, a measured point speaks for cells "
        "that no point falls into; 0 = it does not", low=0.0,
    )  # fmt: skip
    max_splat: float = parameter(
        0.08, "how far at most, in depth: at edges, where depth is least sure, what lies behind is hidden", unit="m",
        low=0.0,
    )  # fmt: skip
    percentiles: tuple[float, ...] = parameter((), "further layers: percentiles of a cell's heights, 50 the median")
    filled: str = parameter(
        "apart", "what refinement made up: a layer of its own, or counted as measured", choices=("apart", "counted")
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
        measured, guessed = self._parted(cloud)
        grid = self.resolution, origin, 2 * half, self.max_range
        figures = self._reached(cell_statistics(measured.points, measured.sigma, *grid), measured, grid)
        layers = self._layers(figures, measured, origin)
        if cloud.sensor is not None and cloud.shape is not None:
            ceiling = np.where(layers["count"] > 0, np.nan, _ceiling(measured, grid))
            layers["ceiling"] = ceiling
            layers["occluded"] = np.where(layers["count"] > 0, 0.0, np.where(np.isfinite(ceiling), 1.0, np.nan))
        if guessed is not None:
            layers["filled"] = _filled(cell_statistics(guessed.points, guessed.sigma, *grid), layers["count"] > 0)
        for value in self.percentiles:
            layers[f"percentile_{value:g}"] = cell_percentile(measured.points, value, *grid)
        return ElevationMap(
            cloud.stamp, {n: layer.astype(np.float32) for n, layer in layers.items()}, self.resolution, origin,
            LEVEL_FRAME,
        )  # fmt: skip

    def _parted(self, cloud: PointCloud) -> tuple[PointCloud, PointCloud | None]:
        """The points that count as measured, and those that are guesses, if there are any."""
        measured = cloud.measured
        if self.filled == "counted" or measured.all():
            return cloud, None
        return cloud.only(measured), cloud.only(~measured)

    def _reached(self, figures: Array, cloud: PointCloud, grid: Grid) -> Array:
        """The figures of `cell_statistics`, those of empty cells that lie within the reach of points filled in."""
        sensor = cloud.sensor
        least = FINEST * self.resolution
        if sensor is None or self.splat_sigmas == 0 or self.max_splat < least:
            return figures
        points, sigma = laid_along_sight(cloud.points, cloud.sigma, sensor, self.splat_sigmas, least, self.max_splat)
        near = cell_statistics(points, sigma, *grid)
        reached = (figures[:, :, 0] == 0) & (near[:, :, 0] >= WITNESSES)
        spoken_for = near[reached]
        spoken_for[:, SUMS] *= REACHED / spoken_for[:, :1]
        figures[reached] = spoken_for
        return figures

    def _layers(self, figures: Array, cloud: PointCloud, origin: tuple[float, float]) -> dict[str, Array]:
        count, total, squares, minimum, maximum, noise = (figures[:, :, i] for i in range(len(FIGURES)))
        empty = count == 0
        n = np.where(empty, np.nan, count)
        mean = total / n
        scatter = np.maximum(squares / n - mean * mean, 0.0)
        middle = np.arange(len(count)) + 0.5
        x, y = middle[None, :] * self.resolution + origin[0], middle[:, None] * self.resolution + origin[1]
        return {
            "elevation": mean,
            "minimum": np.where(empty, np.nan, minimum),
            "maximum": np.where(empty, np.nan, maximum),
            "count": count,
            "variance": self._variance(n, mean, scatter, noise / n, cloud, x, y),
            "common_variance": np.where(empty, np.nan, cloud.tilt_sigma**2 * (x * x + y * y)),
        }

    def _variance(
        self, n: Array, mean: Array, scatter: Array, noise: Array, cloud: PointCloud, x: Array, y: Array
    ) -> Array:
        """The random variance of the cells' means. n, mean, scatter, noise (of depth): (rows, cols), NaN = empty."""
        east, north, bend = gradient_and_curvature(mean)
        rise = east * east + north * north
        noise = noise * _lever(cloud, mean, x, y, east / self.resolution, north / self.resolution) ** 2
        uneven = np.maximum(scatter - rise / 12 - SHOWING * noise, 0.0)
        beside = ~binary_erosion(np.isfinite(mean), np.ones((3, 3)))
        return np.asarray(
            self.tail_factor * noise * (self.systematic_share + np.minimum(1.0, self.correlated_points / n))
            + self.scatter_share * uneven
            + self.curvature_share * bend * bend
            + np.where(beside, self.rim_share * rise, 0.0)
        )


def _lever(cloud: PointCloud, height: Array, x: Array, y: Array, east: Array, north: Array) -> Array:
    """How far the surface found over (x, y) moves up for each metre of depth error: the point moves along its line of
    sight, and with it, on a slope (east, north), the surface. 1 where the camera is not known."""
    if cloud.sensor is None:
        return np.ones_like(height)
    axis, place = cloud.sensor.rotation[:, 2], cloud.sensor.translation
    dx, dy, dz = x - place[0], y - place[1], height - place[2]
    depth = dx * axis[0] + dy * axis[1] + dz * axis[2]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(depth > 0, (dz - east * dx - north * dy) / depth, 1.0))


def _ceiling(cloud: PointCloud, grid: Grid) -> Array:
    """The lowest line of sight over each cell, m, NaN where none jumps over it."""
    assert cloud.sensor is not None
    assert cloud.shape is not None
    x, y, z = (float(value) for value in cloud.sensor.translation)
    return lowest_sight(cloud.points, cloud.pixel, cloud.shape[1], (x, y, z), *grid)


def _filled(figures: Array, known: Array) -> Array:
    """The layer `filled`."""
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = figures[:, :, 1] / figures[:, :, 0]
    return np.where(known, np.nan, mean)
