"""Fuse: local clouds into one regional elevation map in the pose's frame, by inverse variance.

The trick is to resample nothing: a levelled cloud is turned to its heading in the pose's frame and shifted by less than
a cell before it is binned, so that its cells are cells of the region. What moves a frame as a whole, the error of its
tilt and of the pose's height, is a plane, found where the frame overlaps the map and taken off; so neighbouring frames
join without a seam.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from stages.data import LEVEL_FRAME, Array, ElevationMap, Mount, PointCloud, Pose, Tiles, Transform
from stages.kernels.neighbours import lie_of_cells
from stages.kernels.rigid import transform_points
from stages.overlap import fit_plane
from stages.stage import Finding, Severity, Stage, counted, parameter
from stages.voxelise import Voxelise, check_cells

# What is remembered of a cell, 29 bytes. weight: sum of 1 / variance over its frames; best: the smallest standard
# deviation among them; below, above: from the height to the cell's extremes; first, last: ms since the first frame;
# numbers stop at the largest of their type; doubt: by how much the newest frame contradicts it, where that is not
# settled. Where no frame saw it, but one looked, weight is HIDDEN and height what it must lie below.
CELL = np.dtype(
    [
        ("height", "f4"), ("weight", "f4"), ("best", "f2"), ("below", "f2"), ("above", "f2"), ("count", "u2"),
        ("first", "u4"), ("last", "u4"), ("frames", "u2"), ("contradictions", "u1"), ("doubt", "f2"),
    ]
)  # fmt: skip
HIDDEN = -1.0
MARGIN = 1.5  # m; what a cell's slope and step depend on lies within, so that no map ends where they still change
_MS = 1_000_000
_TELLING = 100  # cells that a frame and the map must share for their heights to tell of a jump
LARGEST_JUMP = 5.0  # standard deviations, from one frame to the next, of what joins them to the map
PATIENCE = 3  # frames in succession that do not join the map begin a new one
_STEEPEST = 3.0  # rise per run; a cell at the edge of a rock may be steeper, and what it is off by is bounded
# Beyond this the pose's frame does not have z up. An odometry that knows no tilt may differ by the slope of the ground.
_LARGEST_LEAN = np.radians(30.0)


@dataclass(eq=False)
class Region:
    """The map so far: its frame, the stamps of its first and last frame, ns, whether those tell what was hidden from
    them, its cells, the plane that joined the last frame, how many in succession did not join, and how often the map
    began anew for that."""

    frame_id: str | None = None  # a pose may be in a frame without a name
    epoch: int = 0
    last: int = -1
    hides: bool = False
    cells: Tiles = field(default_factory=lambda: Tiles(CELL))
    plane: Array = field(default_factory=lambda: np.zeros(3))
    refused: int = 0
    anew: int = 0

    def begin(self, frame_id: str, stamp: int) -> None:
        """Start anew: nothing joins the two."""
        self.frame_id, self.epoch, self.cells, self.plane = frame_id, stamp, Tiles(CELL), np.zeros(3)


@dataclass(frozen=True)
class Fuse(Stage):
    """Merges levelled clouds into a regional map, and gives the part of it around the rover.

    The map that a frame gives is a square of `window` about the rover, its sides along the axes of the pose's frame. It
    holds all that the frame changed, so the maps of a run, each laid over those before, are the whole region. Layers:
    - elevation, minimum, maximum, m: means over frames, weighted by inverse variance;
    - variance, m^2: of the elevation against what lies about it. A frame that is misplaced by `position` is off by that
      times the slope, where its cell has one, and by `alignment` anywhere. Frames see a cell alike and err alike: the
      share `shared` of the smallest variance stays, however many frames there are;
    - count (points); first, last: when the evidence in the cell was gathered, s since the map's first frame,
      whose stamp is the map's `epoch` (float32 holds no stamps), another once the map began anew; frames: how many it
      is from (at most 65535); contradictions: how often the height was contradicted;
    - occluded, where the frames tell it: 1 in cells hidden from all that looked, 0 in known ones, NaN elsewhere; and
      ceiling, m: the lowest line of sight over the hidden ones.

    A frame contradicts a cell if it is off by more than `contradiction` standard deviations. Then the cell's evidence
    loses half its weight, and as soon as the newer is as sure, the newer takes its place; until then the cell is stated
    to be as unsure as the two differ.

    Where the pose is in another frame than before, as after visual odometry lost its way, the map begins anew.

    A frame that lies off the map unlike those before, by more than five times what is expected of its errors
    (`tilt_sigma`, `height_sigma`), is refused; with the third in succession the map begins anew, which a warning says
    at the end. Of the plane that joins a frame a small share is left in (`follow_tilt`, `follow_height`), so that in
    the long run the map follows gravity and the pose and not the errors of its first frame.
    """

    resolution: float = parameter(0.05, "cell size", unit="m", low=0.005, high=2.0)
    region: float = parameter(
        8.0, "horizontal range from the rover that a frame adds to the map", unit="m", low=0.1, high=200.0
    )
    window: float = parameter(20.0, "width of the map that is given with each frame", unit="m", low=0.5, high=400.0)
    tilt_sigma: float = parameter(0.005, "standard deviation of a frame's tilt (0.3 degrees)", unit="rad", low=0.0)
    height_sigma: float = parameter(0.05, "standard deviation of the pose's height against the map", unit="m", low=0.0)
    position: float = parameter(
        0.012, "standard deviation of a frame's horizontal place against those it is merged with", unit="m", low=0.0
    )
    alignment: float = parameter(
        0.002, "standard deviation that is left in a cell's height by joining its frame", unit="m", low=1e-4
    )
    follow_tilt: float = parameter(0.05, "share of a frame's own tilt that the map takes over", low=0.0, high=1.0)
    follow_height: float = parameter(
        0.003, "share of its own height; much less, for heights that are pulled lean the map", low=0.0, high=1.0
    )
    contradiction: float = parameter(3.0, "standard deviations that two heights of a cell may differ", low=1.0)
    shared: float = parameter(0.5, "share of a cell's variance that is the same in all frames", low=0.0, high=1.0)

    ordered: ClassVar[bool] = True
    _map: Region = field(default_factory=Region, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_cells("Fuse.window", self.window, self.resolution)
        least = 2 * (self.region + MARGIN)
        if self.window < least:
            raise ValueError(
                f"Fuse.window must be at least {least:g} m, not {self.window:g} m: it holds all that a frame changed "
                f"(region, {self.region:g} m) and {MARGIN:g} m about it"
            )

    def __call__(self, cloud: PointCloud, pose: Pose, mount: Mount | None = None) -> ElevationMap:
        """The regional map around the rover, in the pose's frame, with the cloud, in frame `level`, fused in.

        mount: how the camera sits on the frame whose pose is given; may be left out where that is the camera itself.
        """
        self._check(cloud)
        placed = placement(cloud, pose, mount)
        local, row, col = local_cells(cloud, placed, self.resolution, self.region)
        if pose.frame_id != self._map.frame_id:
            self._map.begin(pose.frame_id, cloud.stamp)
        cells = self._map.cells.read(row, col, *local.shape)
        known = np.isfinite(local.layers["elevation"]) & np.isfinite(local.layers["variance"])
        seen = {name: local.layers[name][known].astype(np.float64) for name in local.layers}
        seen["variance"] += self._misplaced(local)[known]
        x, y = _offsets(known, row, col, placed, self.resolution)
        plane = self._plane(cells[known], seen, x, y)
        if self._jumped(plane):
            self._map.begin(pose.frame_id, cloud.stamp)
            self._map.anew += 1
            cells, plane = self._map.cells.read(row, col, *local.shape), np.zeros(3)
        self._map.plane, self._map.refused = plane, 0
        for height in ("elevation", "minimum", "maximum"):
            seen[height] += plane @ [np.ones_like(x), x, y]
        cells[known] = self._merged(cells[known], seen, (cloud.stamp - self._map.epoch) // _MS)
        ceiling = local.layers.get("ceiling", np.full(known.shape, np.nan))
        hidden = ~known & np.isfinite(ceiling) & (cells["frames"] == 0)
        x, y = _offsets(hidden, row, col, placed, self.resolution)
        cells[hidden] = _below(cells[hidden], ceiling[hidden] + plane @ [np.ones_like(x), x, y])
        self._map.cells.write(row, col, cells, known | hidden)
        self._map.last, self._map.hides = cloud.stamp, "ceiling" in local.layers
        return self._around(cloud.stamp, _lifted(placed, plane))

    def finding(self) -> Finding | None:
        """That the map began anew amid a run, a warning."""
        if not self._map.anew:
            return None
        return Finding(
            f"height or tilt jumped against the map, which began anew in the same frame, {self._map.frame_id}, "
            f"{counted(self._map.anew, 'time')}: maps from before and after that do not join",
            Severity.WARNING,
        )

    def _check(self, cloud: PointCloud) -> None:
        if cloud.frame_id != LEVEL_FRAME or cloud.sensor is None:
            raise ValueError(f"Fuse: the cloud is in frame '{cloud.frame_id}', not '{LEVEL_FRAME}'; it needs Level")
        if cloud.stamp <= self._map.last:
            raise ValueError(f"Fuse: the cloud of {cloud.stamp} ns comes after that of {self._map.last} ns")

    def _misplaced(self, local: ElevationMap) -> Array:
        """What errors of a frame's place add to the variance of its cells, (rows, cols)."""
        east, north, _ = lie_of_cells(local.layers["elevation"].astype(np.float64)) / self.resolution
        return np.asarray(self.alignment**2 + self.position**2 * np.minimum(east**2 + north**2, _STEEPEST**2))

    def _plane(self, cells: Array, seen: dict[str, Array], x: Array, y: Array) -> Array:
        """What a frame has to rise to join the map: (3,) height at the rover, m, and slopes along x and y.

        cells, seen: of the cells that the frame sees, at (x, y) from the rover.
        """
        both = cells["frames"] > 0
        cells, x, y = cells[both], x[both], y[both]
        off = cells["height"].astype(np.float64) - seen["elevation"][both]
        variance = self._variance(cells) + seen["variance"][both]
        expected = np.array([self.height_sigma, self.tilt_sigma, self.tilt_sigma])
        # What joined the frame before tells what to expect: a pose whose height drifts is off by much, but by and by.
        before = np.array([self._map.plane[0], 0.0, 0.0])
        plane = before + fit_plane(x, y, off - before[0], variance, expected, self.resolution)
        # Far enough off, all is an outlier to a robust fit.
        left = np.abs(off - plane @ [np.ones_like(x), x, y])
        explained = self.height_sigma + self.tilt_sigma * (np.abs(x) + np.abs(y)) + np.sqrt(variance)
        if len(off) >= _TELLING and self.height_sigma > 0 and np.median(left - LARGEST_JUMP * explained) > 0:
            return np.array([np.median(off), 0.0, 0.0])
        return np.asarray(plane * (1 - np.array([self.follow_height, self.follow_tilt, self.follow_tilt])))

    def _jumped(self, plane: Array) -> bool:
        """Whether frame after frame does not join the map; raises ValueError for the first of them."""
        change = np.abs(plane - self._map.plane)
        if np.all(change <= LARGEST_JUMP * np.array([self.height_sigma, self.tilt_sigma, self.tilt_sigma])):
            return False
        self._map.refused += 1
        if self._map.refused < PATIENCE:
            raise ValueError(
                f"Fuse: the frame lies {change[0]:.2f} m and {np.degrees(change[1:].max()):.1f} degrees off the map, "
                "unlike those before; its pose or its tilt has jumped, and it is left out of the regional map"
            )
        return True

    def _variance(self, cells: Array) -> Array:
        """Variance of the heights of known cells, m^2."""
        return 1 / cells["weight"].astype(np.float64) + self.shared * cells["best"].astype(np.float64) ** 2

    def _merged(self, cells: Array, seen: dict[str, Array], now: int) -> Array:
        """The cells (n,) with what a frame saw in them at `now`, ms."""
        cells, now = cells.copy(), min(now, np.iinfo(CELL["first"]).max)
        height, variance = seen["elevation"], seen["variance"]
        known = cells["frames"] > 0
        have = np.full(len(cells), np.inf)
        have[known] = self._variance(cells[known])
        contradicted = known & (np.abs(height - cells["height"]) > self.contradiction * np.sqrt(have + variance))
        cells["weight"][contradicted] /= 2
        cells["best"][contradicted] *= np.float16(np.sqrt(2))
        counted = _sum(cells["contradictions"][contradicted], 1)
        have[contradicted] *= 2
        new = ~known | (contradicted & (variance <= have))
        unsettled = contradicted & ~new  # until it is settled which is right, nobody may rely on the cell
        cells["doubt"][unsettled] = np.abs(height - cells["height"])[unsettled]
        cells[new] = np.zeros((), CELL)
        cells["first"][new] = now
        cells["contradictions"][contradicted] = counted

        added = new | (known & ~contradicted)
        weight = 1 / ((1 - self.shared) * variance[added] + 1e-12)
        before = cells[added]
        total = before["weight"] + weight
        share = weight / total
        middle = before["height"] + share * (height[added] - before["height"])
        extremes = {
            name: before[name] + share * (sign * (seen[extreme] - height)[added] - before[name])
            for name, extreme, sign in (("below", "minimum", -1), ("above", "maximum", 1))
        }
        spread = np.sqrt(variance[added])
        after = before.copy()
        after["height"], after["weight"] = middle, total
        after["below"], after["above"] = extremes["below"], extremes["above"]
        after["best"] = np.where(before["frames"] > 0, np.minimum(before["best"], spread), spread)
        after["count"] = _sum(before["count"], seen["count"][added])
        after["last"], after["doubt"] = now, 0
        after["frames"] = _sum(before["frames"], 1)
        cells[added] = after
        return cells

    def _around(self, stamp: int, placed: Transform) -> ElevationMap:
        """The map around the rover."""
        half = int(np.ceil(self.window / 2 / self.resolution - 1e-9))
        col, row = (int(np.floor(place / self.resolution)) - half for place in placed.translation[:2])
        cells = self._map.cells.read(row, col, 2 * half, 2 * half)
        known = cells["frames"] > 0
        layers = {name: np.full(known.shape, np.nan, np.float32) for name in ("elevation", "minimum", "maximum")}
        seen = cells[known]
        layers["elevation"][known] = seen["height"]
        layers["minimum"][known] = seen["height"] - seen["below"]
        layers["maximum"][known] = seen["height"] + seen["above"]
        layers["count"] = cells["count"].astype(np.float32)
        layers["variance"] = np.full(known.shape, np.nan, np.float32)
        layers["variance"][known] = self._variance(seen) + np.square(seen["doubt"].astype(np.float64))
        for name in ("first", "last"):
            layers[name] = np.where(known, cells[name] / 1e3, np.nan).astype(np.float32)
        for name in ("frames", "contradictions"):
            layers[name] = cells[name].astype(np.float32)
        if self._map.hides:
            hidden = cells["weight"] == HIDDEN
            layers["occluded"] = np.where(known, 0, np.where(hidden, 1, np.nan)).astype(np.float32)
            layers["ceiling"] = np.where(hidden, cells["height"], np.nan).astype(np.float32)
        origin = (col * self.resolution, row * self.resolution)
        return ElevationMap(stamp, layers, self.resolution, origin, placed.parent, placed, self._map.epoch)


def _sum(numbers: Array, more: Array | int) -> Array:
    """Unsigned numbers with `more` added, or the largest of their type."""
    most = np.iinfo(numbers.dtype).max
    return np.asarray(np.minimum(numbers + np.asarray(more, np.float64), most).astype(numbers.dtype))


def _below(cells: Array, ceiling: Array) -> Array:
    """Hidden cells (n,) that lie below the heights `ceiling`, too."""
    cells = cells.copy()
    cells["height"] = np.where(cells["weight"] == HIDDEN, np.minimum(cells["height"], ceiling), ceiling)
    cells["weight"] = HIDDEN
    return cells


def placement(cloud: PointCloud, pose: Pose, mount: Mount | None = None) -> Transform:
    """Frame `level` of a levelled cloud in the pose's frame: upright, turned by the pose's heading.

    Pitch and roll of the pose are not used: which way is up, the inclinometer knows. Raises ValueError where nothing
    tells how the frame whose pose it is sits to the camera, or where the pose's frame does not have z up.
    """
    assert cloud.sensor is not None
    child = _child_from_camera(pose, cloud.sensor, mount)
    camera = Rotation.from_quat(pose.quaternion).as_matrix() @ child.rotation
    turned = camera @ cloud.sensor.rotation.T
    lean = float(np.arccos(np.clip(turned[2, 2], -1.0, 1.0)))
    if lean > _LARGEST_LEAN:
        raise ValueError(
            f"Fuse: z of the pose's frame '{pose.frame_id}' is {np.degrees(lean):.0f} degrees off the vertical of the "
            "tilt; give a pose in a frame whose z points up"
        )
    yaw = np.arctan2(turned[1, 0] - turned[0, 1], turned[0, 0] + turned[1, 1])
    rotation = Rotation.from_euler("z", yaw).as_matrix()
    origin = cloud.sensor(child.inverse().translation)  # of the frame whose pose it is, in level
    return Transform(pose.frame_id, LEVEL_FRAME, rotation, pose.position - rotation @ origin)


def _child_from_camera(pose: Pose, sensor: Transform, mount: Mount | None) -> Transform:
    """The camera in the frame whose pose is given."""
    if pose.child_frame_id == sensor.child:
        return Transform(sensor.child, sensor.child, np.eye(3), np.zeros(3))
    base = mount.base_from_camera if mount is not None else None
    if base is None or base.parent != pose.child_frame_id:
        raise ValueError(
            f"Fuse: the pose is that of '{pose.child_frame_id}', and nothing tells how the camera '{sensor.child}' "
            "sits on it; record its static transform, or set base_frame of the source"
        )
    return base


def local_cells(
    cloud: PointCloud, placed: Transform, resolution: float, region: float
) -> tuple[ElevationMap, int, int]:
    """The elevation map of one cloud in the cells of the region, and the row and column there of its first cell.

    cloud: in frame `level`, which is `placed` upright in the region's frame. The map's heights are in that frame.
    """
    cell = np.floor(placed.translation[:2] / resolution).astype(int)
    rest = replace(placed, translation=np.append(placed.translation[:2] - cell * resolution, 0.0))
    points = transform_points(cloud.points, rest.rotation, rest.translation)
    sensor = None if cloud.sensor is None else replace(rest.after(cloud.sensor), parent=LEVEL_FRAME)
    local = Voxelise(resolution=resolution, region=region)(replace(cloud, points=points, sensor=sensor))
    col, row = (int(number) - extent // 2 for number, extent in zip(cell, local.shape[::-1], strict=True))
    heights = [name for name in ("elevation", "minimum", "maximum", "ceiling") if name in local.layers]
    lifted = {name: local.layers[name] + np.float32(placed.translation[2]) for name in heights}
    origin = (col * resolution, row * resolution)
    return replace(local, layers={**local.layers, **lifted}, origin=origin, frame_id=placed.parent), row, col


def _offsets(known: Array, row: int, col: int, placed: Transform, resolution: float) -> tuple[Array, Array]:
    """x and y of the centres of the known cells from the rover, m."""
    rows, cols = np.nonzero(known)
    x, y = ((col + cols + 0.5) * resolution, (row + rows + 0.5) * resolution)
    return x - placed.translation[0], y - placed.translation[1]


def _lifted(placed: Transform, plane: Array) -> Transform:
    """The placement with its plane (height, slopes) added: a rise, and the small rotation that makes the slopes."""
    turn = Rotation.from_rotvec([plane[2], -plane[1], 0.0]).as_matrix()
    return replace(placed, rotation=turn @ placed.rotation, translation=placed.translation + np.array([0, 0, plane[0]]))
