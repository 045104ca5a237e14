"""Fuse: local clouds into the cells of one regional map in the pose's frame, by inverse variance.

Nothing is resampled: a levelled cloud is rotated to its heading in the pose's frame and shifted by less than a cell
before it is binned, so its cells are cells of the map. Errors of a frame's tilt and of the pose's height are a plane.
It is fitted where the frame overlaps the map and removed, so neighbouring frames join without a seam.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flow.contracts import Finding, Severity, StageError, counted
from stages.data import Array, ElevationMap, Mount, PointCloud, Pose, Region, Transform
from stages.data.tiles import put, taken
from stages.stage import Stage, check_cells, check_level, check_types, parameter
from stages.terrain.fused_map import FusedMap, Observation, cells_of, merged, variance_of, with_ceiling
from stages.terrain.height_alignment import fit_plane, plane_height
from stages.terrain.kernels.cell_gradient import gradient_and_curvature
from stages.terrain.map_levelling import MapLevelling, StatedErrors
from stages.terrain.map_region import map_around
from stages.terrain.map_registration import FrameGrid, frame_grid, plane_between, register, with_plane

MIN_OVERLAP_CELLS = 100  # of a frame and the map, for their heights to show a jump
MAX_JUMP = 5.0  # standard deviations of the aligning plane from one frame to the next
MAX_REJECTED = 3  # frames in succession that do not align; then the map is reset
MAX_PLANAR = 1e-6  # of x and y of the quaternion of a pose without roll and pitch
MAX_LEAN_DEG = 5.0  # of the pose's frame; odometry without an inclinometer is off by less than such a mean slope
MAX_GRADIENT = 3.0  # rise per run of a cell in the variance of misplaced frames; rock edges are steeper


@dataclass(frozen=True)
class FuseRegion(Stage):
    """Merges levelled clouds into the cells of a region, which `MapRegion` turns into maps.

    The region starts again if the pose's frame changes. `mount` may be left out if the pose is the camera's.
    docs/terrain.md describes the alignment and the variance.
    """

    resolution: float = parameter(0.05, "cell size", unit="m", low=0.005, high=2.0)
    max_range: float = parameter(
        8.0, "horizontal range from the rover that a frame adds to the map", unit="m", low=0.1, high=200.0
    )
    tilt_sigma: float = parameter(
        0.005, "standard deviation of a frame's tilt (0.3 degrees)", unit="rad", low=0.0, high=0.5
    )
    height_sigma: float = parameter(
        0.05, "standard deviation of the pose's height against the map", unit="m", low=0.0, high=100.0
    )
    attitude_sigma: float = parameter(
        0.0009, "standard deviation of the pose's roll and pitch, if it has no covariance (0.05 degrees)", unit="rad",
        low=0.0, high=0.5,
    )  # fmt: skip
    height_drift: float = parameter(
        0.002, "error of the pose's height per metre of the drive, if it has no covariance", low=0.0, high=1.0
    )
    tilt_bias: float = parameter(
        np.deg2rad(0.1), "standard deviation of the error common to all tilts", unit="rad", low=0.0, high=0.2
    )
    position_sigma: float = parameter(
        0.012, "standard deviation of a frame's horizontal position against the map", unit="m", low=0.0, high=100.0
    )
    alignment_sigma: float = parameter(
        0.002, "standard deviation of a cell's height that the alignment leaves", unit="m", low=1e-4, high=100.0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_cells(f"{type(self).__name__}.max_range", self.max_range, self.resolution, 2)

    def start(self) -> FusedMap:
        """An empty map, the state of one run."""
        return FusedMap()

    def resumed(self, maps: Sequence[ElevationMap]) -> FusedMap:
        """The state at the last of some regional maps as they are in a result log, in the order of their stamps.

        The cloud of its stamp must come next: it is in the map already and only shows where the map lies. The log
        rounds heights and variances, and has no covariance of the alignment; a frame's own is taken.

        Raises
        ------
        ValueError
            If the maps have other cells than `resolution`.
        """
        last = maps[-1]
        if abs(last.resolution / self.resolution - 1) > 1e-6:
            raise ValueError(f"the logged map has cells of {last.resolution:g} m, not {self.resolution:g} m")
        state = FusedMap(last.frame_id, last.epoch or 0, last.stamp, "ceiling" in last.layers, logged=last.level)
        for part in maps:
            if (part.frame_id, part.epoch) == (last.frame_id, last.epoch):
                cells = cells_of(part.layers)
                row, col = (round(part.origin[axis] / self.resolution) for axis in (1, 0))
                state.cells.write(row, col, cells, cells["weight"] != 0)
        return state

    def __call__(self, cloud: PointCloud, pose: Pose, mount: Mount | None = None, *, state: FusedMap) -> Region:
        """The region in the pose's frame, with a cloud in frame `level` merged in."""
        check_types(self, pose=pose, mount=mount)
        self._check(cloud, state)
        level, up = register(self, cloud, pose, mount)
        if state.logged is not None and pose.frame_id == state.frame_id:
            return self._placed(cloud, level, up, pose, state)
        frame = frame_grid(cloud, level, self.resolution, self.max_range)
        if pose.frame_id != state.frame_id:
            state.reset(pose.frame_id, cloud.stamp)
        known, observed = frame.known, self._observation(frame)
        cells, plane = self._aligned(frame, observed, pose, up, cloud.tilt_sigma or self.tilt_sigma, state)
        state.up_sum += up
        state.planar &= not np.any(np.abs(pose.quaternion[:2]) > MAX_PLANAR)
        put(cells, known, merged(taken(cells, known), observed.with_plane(plane), state.age(cloud.stamp)))
        hidden = ~known & np.isfinite(frame.ceiling) & (cells["frames"] == 0)
        ceiling = frame.ceiling[hidden] + plane_height(plane, *frame.offsets(hidden))
        put(cells, hidden, with_ceiling(taken(cells, hidden), ceiling))
        state.cells.write(frame.row, frame.col, cells, known | hidden)
        state.last, state.has_ceiling = cloud.stamp, "ceiling" in frame.terrain.layers
        changed = frame.row, frame.col, frame.row + cells.shape[0], frame.col + cells.shape[1]
        level = with_plane(frame.level, plane)
        now = state.cells.snapshot()
        return Region(cloud.stamp, now, self.resolution, level, state.epoch, changed, state.has_ceiling)

    def _placed(self, cloud: PointCloud, level: Transform, up: Array, pose: Pose, state: FusedMap) -> Region:
        """The region of a result log at its last frame, which shows where it lies."""
        logged = state.logged
        apart = math.inf if logged is None else math.dist(level.translation[:2], logged.translation[:2])
        if logged is None or cloud.stamp != state.last or apart > self.resolution:
            raise StageError(
                f"{type(self).__name__}: the frame of {state.last} ns, the last one in the logged map, has no "
                "cloud, or its pose is more than a cell off that map"
            )
        plane, sigma = plane_between(level, logged), cloud.tilt_sigma or self.tilt_sigma
        levelling = MapLevelling.begin(pose, self._stated).tilted(up, sigma).placed()
        state.levelling, state.plane, state.logged = levelling.at(plane, up), plane, None
        col, row = (math.floor(position / self.resolution) for position in level.translation[:2])
        nothing, cells = (row, col, row, col), state.cells.snapshot()
        return Region(cloud.stamp, cells, self.resolution, logged, state.epoch, nothing, state.has_ceiling)

    def finding(self, state: FusedMap) -> Finding | None:
        """A warning if the map was reset within one frame of the pose, or if that frame leans."""
        found = []
        if state.resets:
            found.append(
                f"Height or tilt jumped by more than {MAX_JUMP:g} sigma. The regional map was reset "
                f"{counted(state.resets, 'time')} (frame {state.frame_id}); the parts are not aligned."
            )
        lean = float(np.degrees(np.arctan2(np.linalg.norm(state.up_sum[:2]), state.up_sum[2])))
        if lean > MAX_LEAN_DEG and not state.planar:  # planar poses are upright on slopes
            found.append(
                f"z of the pose's frame '{state.frame_id}' is {lean:.0f} degrees off the vertical of the tilt. The map "
                "is upright, but its horizontal distances are too short. Record the pose in a frame whose z points up."
            )
        return Finding(" ".join(found), Severity.WARNING, assumes="tilt") if found else None

    def _check(self, cloud: PointCloud, state: FusedMap) -> None:
        check_level(self, cloud)
        if cloud.sensor is None:
            raise StageError(
                f"{type(self).__name__}: the cloud lacks its camera's pose, `sensor`; stages.Level adds it"
            )
        if state.last is not None and cloud.stamp <= state.last and state.logged is None:
            raise StageError(
                f"{type(self).__name__}: the cloud of {cloud.stamp} ns is not later than the last one, {state.last} ns"
            )

    def _observation(self, frame: FrameGrid) -> Observation:
        """The known cells of a frame; the errors of its position are added to their variance."""
        known, layers = np.flatnonzero(frame.known), frame.terrain.layers
        elevation, minimum, maximum, variance, points = (
            layers[name].reshape(-1).take(known).astype(np.float64)
            for name in ("elevation", "minimum", "maximum", "variance", "count")
        )
        slopes = gradient_and_curvature(layers["elevation"].astype(np.float64))[:2] / self.resolution
        gradient = np.minimum(np.square(slopes.reshape(2, -1).take(known, axis=1)).sum(axis=0), MAX_GRADIENT**2)
        variance += self.alignment_sigma**2 + self.position_sigma**2 * gradient
        return Observation(*frame.offsets(frame.known), elevation, minimum, maximum, variance, points)

    def _aligned(
        self, frame: FrameGrid, observed: Observation, pose: Pose, up: Array, tilt_sigma: float, state: FusedMap
    ) -> tuple[Array, Array]:
        """The map's cells (rows, cols) below the frame, and the plane (3,) that aligns the frame to them."""
        cells = state.cells.read(frame.row, frame.col, *frame.terrain.shape)
        if state.levelling is None:
            levelling = MapLevelling.begin(pose, self._stated).tilted(up, tilt_sigma).placed()
        else:
            levelling = state.levelling.moved(pose, self._stated).tilted(up, tilt_sigma)
            expected = levelling.plane(up)
            plane, covariance, overlaps = self._fitted(taken(cells, frame.known), observed, expected)
            if self._jumped(plane, expected, state):
                state.reset(frame.terrain.frame_id, frame.terrain.stamp)
                state.resets += 1
                return self._aligned(frame, observed, pose, up, tilt_sigma, state)  # as the first frame of a new map
            levelling = levelling.overlapped(plane, covariance, up) if overlaps else levelling
        levelling = levelling.corrected()
        state.levelling, state.plane, state.rejected = levelling, levelling.plane(up), 0
        return cells, state.plane

    @property
    def _stated(self) -> StatedErrors:
        return StatedErrors(self.attitude_sigma, self.height_drift, self.tilt_bias)

    @property
    def _plane_sigma(self) -> Array:
        return np.array([self.height_sigma, self.tilt_sigma, self.tilt_sigma])

    def _fitted(self, cells: Array, observed: Observation, expected: Array) -> tuple[Array, Array, bool]:
        """The plane (3,) that fits a frame to the map, its covariance (3, 3), and whether they overlap.

        cells, observed: (n,), the known cells of the frame; expected: the plane where they do not overlap.
        """
        both = cells["frames"] > 0
        cells, observed = taken(cells, both), observed.only(both)
        off = cells["height"].astype(np.float64) - observed.elevation
        variance = variance_of(cells) + observed.variance
        x, y = observed.x, observed.y
        change, covariance = fit_plane(
            x, y, off - plane_height(expected, x, y), variance, self._plane_sigma, self.resolution
        )  # fmt: skip
        plane = expected + change
        # After a large jump a robust fit takes all cells for outliers.
        left = np.abs(off - plane_height(plane, x, y))
        explained = self.height_sigma + self.tilt_sigma * (np.abs(x) + np.abs(y)) + np.sqrt(variance)
        if len(off) >= MIN_OVERLAP_CELLS and self.height_sigma > 0 and np.median(left - MAX_JUMP * explained) > 0:
            plane = np.array([np.median(off), 0.0, 0.0])
        return plane, covariance, len(off) > 0

    def _jumped(self, plane: Array, expected: Array, state: FusedMap) -> bool:
        """Whether too many frames in succession do not align; raises StageError for the first of them.

        plane: (3,), that aligns the frame. It must be near the expected one, or near that of the last frame.
        """
        changes = [np.abs(plane - other) for other in (expected, state.plane)]
        if any(np.all(change <= MAX_JUMP * self._plane_sigma) for change in changes):
            return False
        change = changes[0]
        state.rejected += 1
        if state.rejected < MAX_REJECTED:
            raise StageError(
                f"{type(self).__name__}: the frame lies {change[0]:.2f} m and {np.degrees(change[1:].max()):.1f} "
                "degrees off the map, unlike the frames before; its pose or its tilt has jumped, and it is left out of "
                "the regional map"
            )
        return True


@dataclass(frozen=True)
class Fuse(FuseRegion):
    """Merges levelled clouds into a regional map, and returns the map around the rover with each of them.

    It does at once what `FuseRegion` and `MapRegion` do one after the other, for a map of every frame.

    Examples
    --------
    >>> from stages import Tilt, Level
    >>> cloud = PointCloud(0, np.float32([[0, 1, 3]]), np.zeros((1, 3), np.uint8), np.float32([0.01]), np.int32([0]),
    ...                    "camera")
    >>> level = Level()(cloud, Tilt(0, [0.0, -1.0, 0.0], "camera"))
    >>> fuse, pose = Fuse(), Pose(0, [5, 0, 1], [-0.5, 0.5, -0.5, 0.5], "odom", "camera")
    >>> terrain = fuse(level, pose, state=fuse.start())
    >>> row, col = np.argwhere(np.isfinite(terrain.layers["elevation"]))[0]
    >>> round(terrain.origin[0] + 0.05 * (float(col) + 0.5), 3), round(float(terrain.layers["elevation"][row, col]), 3)
    (8.025, 0.0)
    """

    window: float = parameter(20.0, "least width of the map of each frame", unit="m", low=0.5, high=400.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_cells("Fuse.window", self.window, self.resolution)

    def __call__(  # type: ignore[override]
        self, cloud: PointCloud, pose: Pose, mount: Mount | None = None, *, state: FusedMap
    ) -> ElevationMap:
        """The map around the rover, in the pose's frame, with a cloud in frame `level` merged in."""
        region = super().__call__(cloud, pose, mount, state=state)
        return map_around(region, self.window, region.changed)
