"""Fuse: local clouds into one regional elevation map in the pose's frame, by inverse variance.

The trick is to resample nothing: a levelled cloud is turned to its heading in the pose's frame and shifted by less than
a cell before it is binned, so that its cells are cells of the region. What moves a frame as a whole, the error of its
tilt and of the pose's height, is a plane, found where the frame overlaps the map and taken off; so neighbouring frames
join without a seam.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flow.contracts import Finding, Severity, StageError, counted
from stages.data import LEVEL_FRAME, Array, ElevationMap, Mount, PointCloud, Pose, Transform
from stages.stage import Stage, check_cells, parameter
from stages.terrain.fused_map import FusedMap, Observation, hidden_below, layers_of, merged, variance_of
from stages.terrain.height_alignment import fit_plane, rise
from stages.terrain.kernels.cell_gradient import gradient_and_curvature
from stages.terrain.map_registration import FrameGrid, placement, raised, sight_of

MARGIN = 1.5  # m; what a cell's slope and step depend on lies within, so that no map ends where they still change
_TELLING = 100  # cells that a frame and the map must share for their heights to tell of a jump
LARGEST_JUMP = 5.0  # standard deviations, from one frame to the next, of what joins them to the map
PATIENCE = 3  # frames in succession that do not join the map begin a new one
_LEANING = 5.0  # degrees; an odometry that knows no tilt is off by slopes, but hardly by one mean slope of so much
_STEEPEST = 3.0  # rise per run; a cell at the edge of a rock may be steeper, and what it is off by is bounded


@dataclass(frozen=True)
class Fuse(Stage):
    """Merges levelled clouds into a regional map, and gives the part of it around the rover.

    The map that a frame gives is a square of `window` about the rover, its sides along the axes of the pose's frame. It
    holds all that the frame changed, so the maps of a run, each laid over those before, are the whole region. Layers:
    - elevation, minimum, maximum, m: means over frames, weighted by inverse variance;
    - variance, m^2: of the elevation against what lies about it. A frame that is misplaced by `position_sigma` is off
      by that times the slope, where its cell has one, and by `alignment_sigma` anywhere. Frames see a cell alike and
      err alike: the share `shared_share` of the smallest variance stays, however many frames there are;
    - count (points); first, last: when the evidence in the cell was gathered, s since the map's first frame,
      whose stamp is the map's `epoch` (float32 holds no stamps), another once the map began anew; frames: how many it
      is from (at most 65535); contradictions: how often the height was contradicted;
    - occluded, where the frames tell it: 1 in cells hidden from all that looked, 0 in known ones, NaN elsewhere; and
      ceiling, m: the lowest line of sight over the hidden ones.

    A frame contradicts a cell if it is off by more than `max_contradiction` standard deviations. Then the cell's
    evidence loses half its weight, and as soon as the newer is as sure, the newer takes its place; until then the cell
    is stated to be as unsure as the two differ.

    Where the pose is in another frame than before, as after visual odometry lost its way, the map begins anew.

    A frame that lies off the map unlike those before, by more than five times what is expected of its errors
    (`tilt_sigma`, `height_sigma`), is refused; with the third in succession the map begins anew, which a warning says
    at the end. Of the plane that joins a frame a small share is left in (`follow_tilt`, `follow_height`), so that in
    the long run the map follows gravity and the pose and not the errors of its first frame.
    """

    resolution: float = parameter(0.05, "cell size", unit="m", low=0.005, high=2.0)
    max_range: float = parameter(
        8.0, "horizontal range from the rover that a frame adds to the map", unit="m", low=0.1, high=200.0
    )
    window: float = parameter(20.0, "width of the map that is given with each frame", unit="m", low=0.5, high=400.0)
    tilt_sigma: float = parameter(0.005, "standard deviation of a frame's tilt (0.3 degrees)", unit="rad", low=0.0)
    height_sigma: float = parameter(0.05, "standard deviation of the pose's height against the map", unit="m", low=0.0)
    position_sigma: float = parameter(
        0.012, "standard deviation of a frame's horizontal place against those it is merged with", unit="m", low=0.0
    )
    alignment_sigma: float = parameter(
        0.002, "standard deviation that is left in a cell's height by joining its frame", unit="m", low=1e-4
    )
    follow_tilt: float = parameter(0.05, "share of a frame's own tilt that the map takes over", low=0.0, high=1.0)
    follow_height: float = parameter(
        0.003, "share of its own height; much less, for heights that are pulled lean the map", low=0.0, high=1.0
    )
    max_contradiction: float = parameter(3.0, "standard deviations that two heights of a cell may differ", low=1.0)
    shared_share: float = parameter(0.5, "share of a cell's variance that is the same in all frames", low=0.0, high=1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_cells("Fuse.window", self.window, self.resolution)
        least = 2 * (self.max_range + MARGIN)
        if self.window < least:
            raise ValueError(
                f"Fuse.window must be at least {least:g} m, not {self.window:g} m: it holds all that a frame changed "
                f"(region, {self.max_range:g} m) and {MARGIN:g} m about it"
            )

    def start(self) -> FusedMap:
        """An empty map, the memory of one run."""
        return FusedMap()

    def __call__(self, cloud: PointCloud, pose: Pose, mount: Mount | None = None, *, state: FusedMap) -> ElevationMap:
        """The regional map around the rover, in the pose's frame, with the cloud, in frame `level`, fused in.

        mount: how the camera sits on the frame whose pose is given; may be left out where that is the camera itself.
        state: the map so far.
        """
        self._check(cloud, state)
        placed, up = placement(cloud, pose, mount)
        sight = sight_of(cloud, placed, self.resolution, self.max_range)
        if pose.frame_id != state.frame_id:
            state.begin(pose.frame_id, cloud.stamp)
        known, seen = sight.known, self._seen(sight)
        cells, plane = self._joined(sight, seen, state)
        state.ups += up
        now = state.age(cloud.stamp)
        cells[known] = merged(cells[known], seen.raised(plane), now, self.max_contradiction, self.shared_share)
        hidden = ~known & np.isfinite(sight.ceiling) & (cells["frames"] == 0)
        cells[hidden] = hidden_below(cells[hidden], sight.ceiling[hidden] + rise(plane, *sight.offsets(hidden)))
        state.cells.write(sight.row, sight.col, cells, known | hidden)
        state.last, state.hides = cloud.stamp, "ceiling" in sight.terrain.layers
        return self._window(cloud.stamp, raised(sight.placed, plane), state)

    def finding(self, state: FusedMap) -> Finding | None:
        """That the map began anew amid a run, and that its frame leans, a warning."""
        found = []
        if state.anew:
            found.append(
                f"height or tilt jumped against the map, which began anew in the same frame, {state.frame_id}, "
                f"{counted(state.anew, 'time')}: maps from before and after that do not join"
            )
        lean = float(np.degrees(np.arctan2(np.linalg.norm(state.ups[:2]), state.ups[2])))
        if lean > _LEANING:
            found.append(
                f"z of the pose's frame '{state.frame_id}' is {lean:.0f} degrees off the vertical of the tilt: the "
                "map is upright and its way is foreshortened; record the pose in a frame whose z points up"
            )
        return Finding("; ".join(found), Severity.WARNING) if found else None

    def _check(self, cloud: PointCloud, state: FusedMap) -> None:
        if cloud.frame_id != LEVEL_FRAME or cloud.sensor is None:
            raise StageError(f"Fuse: the cloud is in frame '{cloud.frame_id}', not '{LEVEL_FRAME}'; it needs Level")
        if cloud.stamp <= state.last:
            raise StageError(f"Fuse: the cloud of {cloud.stamp} ns comes after that of {state.last} ns")

    def _seen(self, sight: FrameGrid) -> Observation:
        """What a frame shows of the cells that it knows; its errors of place are added to their variance."""
        known, layers = sight.known, sight.terrain.layers
        elevation, minimum, maximum, variance, points = (
            layers[name][known].astype(np.float64) for name in ("elevation", "minimum", "maximum", "variance", "count")
        )
        variance += self._misplaced(sight.terrain)[known]
        return Observation(*sight.offsets(known), elevation, minimum, maximum, variance, points)

    def _misplaced(self, terrain: ElevationMap) -> Array:
        """What errors of a frame's place add to the variance of its cells, (rows, cols)."""
        east, north, _ = gradient_and_curvature(terrain.layers["elevation"].astype(np.float64)) / self.resolution
        return np.asarray(
            self.alignment_sigma**2 + self.position_sigma**2 * np.minimum(east**2 + north**2, _STEEPEST**2)
        )

    def _joined(self, sight: FrameGrid, seen: Observation, state: FusedMap) -> tuple[Array, Array]:
        """The region's cells (rows, cols) that the frame lies on, and the plane (3,) that joins it to them; where that
        jumped, cells of a map that begins anew."""
        cells = state.cells.read(sight.row, sight.col, *sight.terrain.shape)
        plane = self._plane(cells[sight.known], seen, state.plane)
        if self._jumped(plane, state):
            state.begin(sight.terrain.frame_id, sight.terrain.stamp)
            state.anew += 1
            cells, plane = np.zeros_like(cells), np.zeros(3)
        state.plane, state.refused = plane, 0
        return cells, plane

    def _plane(self, cells: Array, seen: Observation, last: Array) -> Array:
        """What a frame has to rise to join the map: (3,) height at the rover, m, and slopes along x and y.

        cells, seen: (n,), of the cells that the frame knows; last: the plane that joined the frame before.
        """
        both = cells["frames"] > 0
        cells, seen = cells[both], seen.only(both)
        off = cells["height"].astype(np.float64) - seen.elevation
        variance = variance_of(cells, self.shared_share) + seen.variance
        expected = np.array([self.height_sigma, self.tilt_sigma, self.tilt_sigma])
        # What joined the frame before tells what to expect: a pose whose height drifts is off by much, but by and by.
        before = np.array([last[0], 0.0, 0.0])
        plane = before + fit_plane(seen.x, seen.y, off - before[0], variance, expected, self.resolution)
        # Far enough off, all is an outlier to a robust fit.
        left = np.abs(off - rise(plane, seen.x, seen.y))
        explained = self.height_sigma + self.tilt_sigma * (np.abs(seen.x) + np.abs(seen.y)) + np.sqrt(variance)
        if len(off) >= _TELLING and self.height_sigma > 0 and np.median(left - LARGEST_JUMP * explained) > 0:
            return np.array([np.median(off), 0.0, 0.0])
        return np.asarray(plane * (1 - np.array([self.follow_height, self.follow_tilt, self.follow_tilt])))

    def _jumped(self, plane: Array, state: FusedMap) -> bool:
        """Whether frame after frame does not join the map; raises ValueError for the first of them."""
        change = np.abs(plane - state.plane)
        if np.all(change <= LARGEST_JUMP * np.array([self.height_sigma, self.tilt_sigma, self.tilt_sigma])):
            return False
        state.refused += 1
        if state.refused < PATIENCE:
            raise StageError(
                f"Fuse: the frame lies {change[0]:.2f} m and {np.degrees(change[1:].max()):.1f} degrees off the map, "
                "unlike those before; its pose or its tilt has jumped, and it is left out of the regional map"
            )
        return True

    def _window(self, stamp: int, placed: Transform, state: FusedMap) -> ElevationMap:
        """The map around the rover."""
        half = int(np.ceil(self.window / 2 / self.resolution - 1e-9))
        col, row = (int(np.floor(place / self.resolution)) - half for place in placed.translation[:2])
        layers = layers_of(state.cells.read(row, col, 2 * half, 2 * half), self.shared_share, state.hides)
        origin = (col * self.resolution, row * self.resolution)
        return ElevationMap(stamp, layers, self.resolution, origin, placed.parent, placed, state.epoch)
