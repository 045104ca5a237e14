"""The regional map of simulated traverses: seams between neighbouring frames, errors against the truth, cost.

A seam is the height difference of two neighbouring frames in the cells where they overlap. It is printed for frames
placed by pose and tilt alone, and for frames placed by `stages.Fuse` (the transform odom <- level of the result log).
The truth is the mean height of the exact surface over each cell that a frame changed. It is moved into the pose's frame
with that frame's own pose, so errors of odometry do not count. A plane per frame, the error of the tilt, is removed.
The last line covers the cells of all traverses.

A second table shows the lean and the height of the last map of longer drives with exact odometry and noisy tilts.
"""

from __future__ import annotations

import itertools
import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from recordings import McapSource
from recordings.mcap.file import iter_decoded
from recordings.ros2 import from_msg as ros2
from recordings.ros2.from_msg import transform_of
from recordings.scoring.metrics import without_plane
from recordings.simulator import Simulation, raycast, traverse, write_log
from stages.data import LEVEL_FRAME, Array, ElevationMap, Pose, Transform
from stages.terrain.height_alignment import fit_plane
from tests.bench.pipeline import roverflow

RUNS = ((11, 0.05), (12, 0.15), (13, 0.15))
FRAMES = 8
DRIVES = (("gravel", 1), ("gravel", 2), ("gravel", 3), ("mixed", 1))
DRIVE_FRAMES, PART = 50, 1.0  # PART: m, length of a part of a drive whose height is compared with the truth
MIN_CELLS = 300  # of a part
CELL, REACH, FINE = 0.05, 8.0, 3  # FINE: points along a cell's side that its true mean is of
COLUMNS = (
    ("seed", 5), ("rocks k", 8), ("seam cm: placed", 16), ("worst", 6), ("fused", 6), ("worst", 6), ("RMSE cm", 8),
    ("within 1, 2 sigma %", 20), ("ms a frame: map", 16), ("navigation", 11),
)  # fmt: skip


@dataclass(frozen=True)
class RegionFigures:
    """Figures of the regional map of a traverse. seams: (frames - 1, 2) m, placed and fused; errors: (n,) m, of cells
    that frames changed; sigmas: (n,) m, stated for them; seconds: by stream."""

    seams: Array
    errors: Array
    sigmas: Array
    seconds: dict[str, float]

    def row(self) -> list[str]:
        """The figures of the table."""
        seams = [figure for which in self.seams.T for figure in (np.median(which), which.max())]
        return [
            *(f"{100 * value:.2f}" for value in seams),
            f"{100 * np.sqrt(np.mean(self.errors**2)):.2f}", within([self]),
            *(f"{1e3 * self.seconds[name] / FRAMES:.0f}" for name in ("regional_map", "regional_navigation_map")),
        ]  # fmt: skip


def main() -> None:
    """Print a row per traverse, and how well the stated sigmas fit over all."""
    print(f"\nregional map: {FRAMES} frames of 1280x960, inclinometer noise 0.3 degrees, slopes of 8 degrees (RMS)")
    print(" ".join(f"{name:>{width}}" for name, width in COLUMNS))
    regions = []
    for seed, abundance in RUNS:
        with tempfile.TemporaryDirectory() as folder:
            regions.append(region(traverse_of(seed, abundance), Path(folder)))
        cells = [str(seed), f"{abundance:g}", *regions[-1].row()]
        print(" ".join(f"{cell:>{width}}" for cell, (_, width) in zip(cells, COLUMNS, strict=True)), flush=True)
    print(f"within 1, 2 sigma, all cells: {within(regions)} %")
    print(f"\nlast map of {DRIVE_FRAMES} frames of 640x480 against exact odometry, inclinometer noise 0.2 degrees")
    for scene, seed in DRIVES:
        with tempfile.TemporaryDirectory() as folder:
            lean, height, worst = drift(drive_of(scene, seed), Path(folder))
        heights = f"height {100 * height:+.2f} cm, of the worst metre {100 * worst:+.2f} cm"
        print(f"{scene} {seed}: lean {np.degrees(lean):.3f} degrees, {heights}", flush=True)


def traverse_of(seed: int, abundance: float) -> Simulation:
    """A traverse as the table has them."""
    return Simulation(
        scene="gravel", frames=FRAMES, seed=seed, abundance=abundance, slope=np.radians(8), tilt_noise=np.radians(0.3)
    )  # fmt: skip


def drive_of(scene: str, seed: int) -> Simulation:
    """A drive with exact odometry."""
    return Simulation(
        frames=DRIVE_FRAMES, width=640, height=480, seed=seed, scene=scene, tilt_noise=np.radians(0.2),
        odometry_scale=0.0, odometry_turn=0.0,
    )  # fmt: skip


def drift(simulation: Simulation, folder: Path) -> tuple[float, float, float]:
    """The lean, rad, of the last map; its height, m, less the truth; and the same of the worst metre of the drive."""
    out = _run(simulation, folder)
    terrain = list(_frames(out).values())[-1]["/nav/regional_map"]
    assert isinstance(terrain, ElevationMap)
    known = np.isfinite(terrain.layers["elevation"])
    x, y = ((np.arange(n) + 0.5) * CELL + at for n, at in zip(terrain.shape[::-1], terrain.origin, strict=True))
    odom = traverse.level_pose(simulation.base_at(simulation.odometry[0].stamp))
    error = terrain.layers["elevation"][known] - _surface(simulation, odom, x, y, known) + odom.translation[2]
    east, north = (middle[known] for middle in np.meshgrid(x, y))
    centred, loose = (east - east.mean(), north - north.mean()), np.full(3, 10.0)
    plane, _ = fit_plane(*centred, error, terrain.layers["variance"][known].astype(np.float64), loose, CELL)
    track = np.array([pose.position for pose in simulation.odometry])
    ends = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(track[:, :2], axis=0), axis=1)))
    near = track[np.searchsorted(ends, np.arange(0.0, ends[-1] + REACH, PART)).clip(max=len(track) - 1)]
    nearest = np.argmin(np.hypot(east[:, None] - near[:, 0], north[:, None] - near[:, 1]), axis=1)
    parts = [error[nearest == part] for part in range(len(near))]
    heights = [float(np.median(part)) for part in parts if len(part) >= MIN_CELLS]
    return float(np.hypot(*plane[1:])), float(plane[0]), max(heights, key=abs)


def region(simulation: Simulation, folder: Path) -> RegionFigures:
    """The regional map of a traverse, by the command line's default pipeline."""
    log, out, summary = (folder / name for name in ("log.mcap", "out.mcap", "summary.json"))
    _run(simulation, folder)
    frames = _frames(out)
    errors = _errors(simulation, [frame["/nav/regional_map"] for frame in frames.values()])
    return RegionFigures(_seams(simulation, log, frames), *errors, json.loads(summary.read_text())["seconds"])


def _run(simulation: Simulation, folder: Path) -> Path:
    """The result log of a simulation."""
    log, out, summary = (folder / name for name in ("log.mcap", "out.mcap", "summary.json"))
    write_log(simulation, log)
    setting = "regional_elevation.step=0"  # a map a frame
    roverflow("run", log, "-o", out, "--no-rrd", "--summary", summary, "--set", setting)
    return out


def shares_within(regions: list[RegionFigures]) -> tuple[float, float]:
    """Shares of the cells of all regions that are within one and two stated standard deviations."""
    sigmas = np.concatenate([np.abs(found.errors) / found.sigmas for found in regions])
    return float(np.mean(sigmas <= 1)), float(np.mean(sigmas <= 2))


def within(regions: list[RegionFigures]) -> str:
    """The same, in percent."""
    return ", ".join(f"{100 * share:.1f}" for share in shares_within(regions))


def _frames(out: Path) -> dict[int, dict[str, object]]:
    """Stamp -> results of a frame: the points (N, 3), the map, and `level` in the map's frame."""
    frames: dict[int, dict[str, object]] = {}
    for topic, stamp, message in iter_decoded(out, ["/nav/points", "/nav/regional_map", "/tf"]):
        frame = frames.setdefault(stamp, {})
        if topic == "/nav/points":
            fields = ros2.read_point_cloud(message)
            frame[topic] = np.column_stack([fields[name] for name in "xyz"])
        elif topic == "/nav/regional_map":
            frame[topic] = ros2.read_grid_map(message)
        else:
            placed = [transform_of(item) for item in message.transforms if item.child_frame_id == LEVEL_FRAME]
            frame["level"] = placed[0]
    return frames


def _seams(simulation: Simulation, log: Path, frames: dict[int, dict[str, object]]) -> Array:
    """NMAD of the height differences of each pair of neighbouring frames, placed by the pose alone and as fused."""
    with McapSource().open(log) as opened:
        poses = [item for _, stream, item in opened.events(["odometry"])]
    seams, before = [], None
    for stamp, frame in frames.items():
        now = [_heights(frame["/nav/points"], placed) for placed in (_upright(poses, stamp), frame["level"])]
        if before is not None:
            seams.append([_nmad(one, other) for one, other in zip(before, now, strict=True)])
        before = now
    return np.array(seams)


def _upright(poses: Sequence[Pose], stamp: int) -> Transform:
    """Frame `level` by the position and heading of the pose at `stamp`."""
    later = next(place for place, pose in enumerate(poses) if pose.stamp >= stamp)
    return traverse.level_pose(poses[later - 1].interpolated(poses[later], stamp).transform)


def _heights(points: Array, placed: Transform) -> tuple[Array, Array]:
    """Numbers of the cells that contain points, and the mean heights in them."""
    moved = placed(points[np.hypot(points[:, 0], points[:, 1]) <= REACH])
    places = np.floor(moved[:, :2] / CELL).astype(np.int64) + 1_000_000
    cells, which = np.unique(places[:, 1] * 2_000_000 + places[:, 0], return_inverse=True)
    return cells, np.bincount(which, moved[:, 2]) / np.bincount(which)


def _nmad(one: tuple[Array, Array], other: tuple[Array, Array]) -> float:
    _, here, there = np.intersect1d(one[0], other[0], return_indices=True)
    off = one[1][here] - other[1][there]
    return float(1.4826 * np.median(np.abs(off - np.median(off))))


def _errors(simulation: Simulation, maps: list[ElevationMap]) -> tuple[Array, Array]:
    """Errors of the cells that each frame changed, less a plane, and their standard deviations."""
    errors, sigmas = [], []
    for terrain in maps:
        layers, now = terrain.layers, simulation.base_at(terrain.stamp)
        true = traverse.level_pose(now)
        given = _upright(simulation.odometry, terrain.stamp)
        rows, cols = terrain.shape
        fresh = np.isfinite(layers["last"]) & (layers["last"] >= np.nanmax(layers["last"]))
        x, y = ((np.arange(n) + 0.5) * CELL + at for n, at in zip((cols, rows), terrain.origin, strict=True))
        error = np.full((rows, cols), np.nan)
        error[fresh] = layers["elevation"][fresh] - _surface(simulation, true.after(given.inverse()), x, y, fresh)
        error[fresh] -= given.translation[2] - true.translation[2]
        errors.append(without_plane(x, y, error)[fresh])
        sigmas.append(np.sqrt(layers["variance"][fresh]))
    return np.concatenate(errors), np.concatenate(sigmas)


def _surface(simulation: Simulation, world: Transform, x: Array, y: Array, cells: Array) -> Array:
    """Mean height over each of the cells (rows, cols) bool, m of the world; `world` turns about z only."""
    scene = simulation.terrain.scene
    offset = ((np.arange(FINE) + 0.5) / FINE - 0.5) * CELL
    east, north = (middle[cells] for middle in np.meshgrid(x, y))
    heights = np.zeros(len(east))
    for dx, dy in itertools.product(offset, offset):
        place = world(np.column_stack([east + dx, north + dy, np.zeros(len(east))]))
        heights += raycast.tops_at(scene, place[:, 0], place[:, 1], float(scene.ceiling))[0] / FINE**2
    return heights


if __name__ == "__main__":
    main()
