"""A run's output log against the truth topics of the log it ran on: one table of errors.

Results under /nav and truth under /truth meet by header stamp. Both logs are read side by side in log time and a frame
is scored as soon as neither can add to it, so long logs fit in memory. Errors are counted where the truth says that
both cameras saw the ground; a value given elsewhere is counted as such, not excused.
"""

from __future__ import annotations

import heapq
import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from recordings import measures, ros2
from recordings.errors import LogError
from stages.data import LEVEL_FRAME, Array, Cell, ElevationMap

RESULTS = ("/nav/disparity", "/nav/elevation_map", "/nav/navigation_map")
TRUTHS = (
    "/truth/disparity", "/truth/occlusion", "/truth/elevation_map", "/truth/navigation_map", "/truth/rocks",
    "/truth/tilt",
)  # fmt: skip
PATIENCE = 5_000_000_000  # ns of log time after which no log adds to a frame any more
RINGS = ((0.0, 4.0), (4.0, 8.0))  # m from base_link
HIGH_ROCK = 0.2  # m
SEEN_BY_BOTH = 255


@dataclass(frozen=True)
class Score:
    """Errors of a run. Shares 0 to 1, lengths m, disparities px, angles rad; NaN where there was nothing to measure.

    frames: in the truth; compared: those with at least one result; missing: result topic -> stamps of true frames that
    it lacks; unmatched: result topic -> messages at stamps without truth; disparity: `measures.disparity_measures`;
    elevation: "0-4 m", "4-8 m", "0-8 m" -> completeness, raw and levelled `measures.height_measures`; unseen: share of
    the elevations given in cells that nobody saw; navigation: `measures.hazard_measures`; rocks: seen, found, recall;
    tilt: frames, mean, max; per_frame: the main figures of each frame.
    """

    frames: int
    compared: int
    missing: dict[str, list[int]]
    unmatched: dict[str, int]
    disparity: dict[str, float] | None = None
    elevation: dict[str, Any] | None = None
    unseen: float = math.nan
    navigation: dict[str, float] | None = None
    rocks: dict[str, float] | None = None
    tilt: dict[str, float] | None = None
    per_frame: list[dict[str, float]] = field(default_factory=list)

    def to_json(self) -> str:
        """JSON text; NaN becomes null."""
        return json.dumps(_without_nan(asdict(self)), indent=2, allow_nan=False)


def score(result: Path, truth: Path) -> Score:
    """Compare the log `result` of a run with the truth topics of the log `truth`.

    Raises LogError where either has nothing to compare, or where their grids or images do not fit.
    """
    tally = _Tally(Path(result), Path(truth))
    for stamp, frame in _frames(Path(result), Path(truth), tally):
        tally.add(stamp, frame)
    return tally.score()


def _frames(result: Path, truth: Path, tally: _Tally) -> Iterator[tuple[int, dict[str, Any]]]:
    """(stamp, {topic: message}) of all frames of both logs, each when it is complete."""
    streams = [
        ros2.iter_messages(result, [*RESULTS, "/tf"]),
        ros2.iter_messages(truth, [*TRUTHS, "/tf_static"]),
    ]
    waiting: dict[int, dict[str, Any]] = {}
    for topic, log_time, message in heapq.merge(*streams, key=lambda item: item[1]):
        if topic in ("/tf", "/tf_static"):
            for item in message.transforms:
                if topic == "/tf_static":
                    tally.mounts[item.child_frame_id] = item
                elif item.header.frame_id == LEVEL_FRAME:
                    waiting.setdefault(ros2.stamp_of(item.header), {})["/tf"] = item
            continue
        waiting.setdefault(ros2.stamp_of(message.header), {})[topic] = message
        for stamp in [stamp for stamp in waiting if stamp < log_time - PATIENCE]:
            yield stamp, waiting.pop(stamp)
    for stamp in sorted(waiting):
        yield stamp, waiting.pop(stamp)


class _Tally:
    """Sums up frames; what needs a median keeps its errors, everything else only counts."""

    def __init__(self, result: Path, truth: Path) -> None:
        self.result, self.truth = result, truth
        self.mounts: dict[str, Any] = {}
        self.frames = self.compared = 0
        self.missing: dict[str, list[int]] = {topic: [] for topic in RESULTS}
        self.unmatched: dict[str, int] = {}
        self.seen_results: set[str] = set()
        self.disparity: list[dict[str, float]] = []
        self.raw: list[Array] = []
        self.levelled: list[Array] = []
        self.radius: list[Array] = []
        self.values = self.values_unseen = 0
        self.cells: list[Array] = []
        self.true_cells: list[Array] = []
        self.rocks_seen = self.rocks_found = 0
        self.tilts: list[float] = []
        self.per_frame: list[dict[str, float]] = []

    def add(self, stamp: int, frame: dict[str, Any]) -> None:
        results = [topic for topic in RESULTS if topic in frame]
        self.seen_results.update(results)
        if not any(topic in frame for topic in TRUTHS):
            for topic in results:
                self.unmatched[topic] = self.unmatched.get(topic, 0) + 1
            return
        self.frames += 1
        self.compared += bool(results)
        for topic in RESULTS:
            if topic not in frame:
                self.missing[topic].append(stamp)
        row: dict[str, float] = {"stamp": stamp}
        if {"/nav/disparity", "/truth/disparity", "/truth/occlusion"} <= frame.keys():
            row |= self._add_disparity(stamp, frame)
        if "/truth/elevation_map" in frame:
            self._add_maps(stamp, frame, row)
        if {"/tf", "/truth/tilt"} <= frame.keys():
            self._add_tilt(frame, row)
        self.per_frame.append(row)

    def _add_disparity(self, stamp: int, frame: dict[str, Any]) -> dict[str, float]:
        estimate, true = (ros2.read_disparity(frame[f"/{place}/disparity"]) for place in ("nav", "truth"))
        if estimate.shape != true.shape:
            raise LogError(
                f"{self.result}: /nav/disparity at {stamp} ns is {estimate.shape[1]}x{estimate.shape[0]}, the truth in "
                f"{self.truth} is {true.shape[1]}x{true.shape[0]}; score a run of that very log"
            )
        mask = frame["/truth/occlusion"]
        both = np.asarray(mask.data).reshape(mask.height, mask.step)[:, : mask.width] == SEEN_BY_BOTH
        found = measures.disparity_measures(estimate, true, both)
        self.disparity.append(found)
        return {f"disparity_{name}": found[name] for name in ("density", "bad_1", "rmse")}

    def _add_maps(self, stamp: int, frame: dict[str, Any], row: dict[str, float]) -> None:
        true = ros2.read_grid_map(frame["/truth/elevation_map"])
        x, y = (
            (np.arange(n) + 0.5) * true.resolution + at for n, at in zip(true.shape[::-1], true.origin, strict=True)
        )
        radius = np.hypot(x[None, :], y[:, None])
        visible = (true.layers["visible"] > 0.5) & (radius <= RINGS[-1][1])
        if "/nav/elevation_map" in frame:
            given = ros2.read_grid_map(frame["/nav/elevation_map"])
            elevation = self._aligned(stamp, given, given.layers["elevation"], true, np.nan)
            error = np.where(visible, elevation - true.layers["elevation"], np.float32(np.nan)).astype(np.float64)
            levelled = measures.without_plane(x, y, error)
            self.raw.append(error[visible].astype(np.float32))
            self.levelled.append(levelled[visible].astype(np.float32))
            self.radius.append(radius[visible].astype(np.float32))
            known = np.isfinite(elevation)
            self.values += int(known.sum())
            self.values_unseen += int((known & ~(true.layers["visible"] > 0.5)).sum())
            found = measures.height_measures(error)
            row |= {"elevation_rmse": found["rmse"], "elevation_bias": found["bias"]}
        if {"/nav/navigation_map", "/truth/navigation_map"} <= frame.keys():
            told = ros2.read_occupancy_grid(frame["/nav/navigation_map"])
            cells = self._aligned(stamp, told, told.cells, true, Cell.UNKNOWN)
            hazards = ros2.read_occupancy_grid(frame["/truth/navigation_map"])
            true_cells = self._aligned(stamp, hazards, hazards.cells, true, Cell.UNKNOWN)
            self.cells.append(cells[visible])
            self.true_cells.append(true_cells[visible])
            if "/truth/rocks" in frame:
                seen, found_rocks = measures.rocks_found(
                    _high_rocks(frame["/truth/rocks"]), cells, visible, x, y, true.resolution
                )
                self.rocks_seen += int(seen.sum())
                self.rocks_found += int(found_rocks.sum())
                row |= {"rocks_seen": float(seen.sum()), "rocks_found": float(found_rocks.sum())}

    def _aligned(self, stamp: int, grid: Any, values: Array, onto: ElevationMap, missing: float) -> Array:
        where = f"{self.result}: {type(grid).__name__} at {stamp} ns"
        if abs(grid.resolution - onto.resolution) > 1e-4 * onto.resolution:
            raise LogError(
                f"{where} has cells of {grid.resolution} m, the truth has {onto.resolution} m; run with that resolution"
            )
        if grid.frame_id != onto.frame_id:
            raise LogError(f"{where} is in frame '{grid.frame_id}', the truth is in '{onto.frame_id}'")
        try:
            return measures.aligned(values, grid.origin, onto.shape, onto.origin, onto.resolution, missing)
        except ValueError as error:
            raise LogError(f"{where}: {error}; run with whole cells about base_link") from error

    def _add_tilt(self, frame: dict[str, Any], row: dict[str, float]) -> None:
        item = frame["/tf"]
        mount = self.mounts.get(item.child_frame_id)
        if mount is None:
            return
        level_from_base, base_from_camera = (
            _rotation(frame["/truth/tilt"].quaternion),
            _rotation(mount.transform.rotation),
        )
        # Gravity's opposite in camera axes: heading does not enter.
        true_up = (level_from_base @ base_from_camera)[2]
        row["tilt"] = measures.angle_between(_rotation(item.transform.rotation)[2], true_up)
        self.tilts.append(row["tilt"])

    def score(self) -> Score:
        """The tally as a score; LogError if there was nothing to compare."""
        if not self.frames:
            raise LogError(f"{self.truth} has no ground truth (/truth/...); give the simulated log with --truth")
        if not self.seen_results:
            raise LogError(f"{self.result} has no results ({', '.join(RESULTS)}); give the log that a run wrote")
        if not self.compared:
            raise LogError(f"no result of {self.result} has the stamp of a true frame of {self.truth}; is it its run?")
        return Score(
            self.frames, self.compared,
            missing={topic: stamps for topic, stamps in self.missing.items() if stamps},
            unmatched=self.unmatched,
            disparity=measures.pooled_disparity(self.disparity) if self.disparity else None,
            elevation=self._elevation() if self.raw else None,
            unseen=measures.share(self.values_unseen, self.values),
            navigation=self._navigation(),
            rocks={
                "seen": self.rocks_seen, "found": self.rocks_found,
                "recall": measures.share(self.rocks_found, self.rocks_seen),
            } if self.cells else None,
            tilt={
                "frames": len(self.tilts), "mean": float(np.mean(self.tilts)), "max": float(np.max(self.tilts))
            } if self.tilts else None,
            per_frame=self.per_frame,
        )  # fmt: skip

    def _elevation(self) -> dict[str, Any]:
        raw, levelled, radius = (np.concatenate(parts) for parts in (self.raw, self.levelled, self.radius))
        rings = {}
        for low, high in (*RINGS, (RINGS[0][0], RINGS[-1][1])):
            ring = (radius >= low) & (radius <= high)
            rings[f"{low:g}-{high:g} m"] = {
                "completeness": measures.share(np.count_nonzero(np.isfinite(raw[ring])), np.count_nonzero(ring)),
                "raw": measures.height_measures(raw[ring]),
                "levelled": measures.height_measures(levelled[ring]),
            }
        return rings

    def _navigation(self) -> dict[str, float] | None:
        if not self.cells:
            return None
        told, true = np.concatenate(self.cells), np.concatenate(self.true_cells)
        return measures.hazard_measures(told, true, np.ones(told.shape, bool))


def format_score(found: Score) -> str:
    """The score as a table for a terminal."""
    lines = [f"frames       {found.compared} of {found.frames} compared"]
    lines += [
        f"missing      {topic}: {len(stamps)} of {found.frames} frames" for topic, stamps in found.missing.items()
    ]
    lines += [
        f"unmatched    {topic}: {count} messages at stamps without truth" for topic, count in found.unmatched.items()
    ]
    if (d := found.disparity) is not None:
        lines += [
            "",
            f"disparity    {d['pixels']:.0f} pixels seen by both cameras, {_percent(d['density'])} known",
            f"             {_bad(d, '')}  (unknown is bad)",
            f"             {_bad(d, '_known')}  of the known; mean {d['mae']:.3f} px, RMS {d['rmse']:.3f} px",
        ]
    if found.elevation is not None:
        lines += ["", "elevation                 cells  complete   RMSE    MAE   bias   NMAD  (cm)  within 5 cm"]
        for ring, row in found.elevation.items():
            for kind, title in (("raw", ring), ("levelled", f"{ring}, plane removed")):
                h = row[kind]
                errors = "".join(f"{100 * h[name]:7.2f}" for name in ("rmse", "mae", "bias", "nmad"))
                complete, close = _percent(row["completeness"]), _percent(h["within_5cm"])
                lines.append(f"  {title:<22} {h['cells']:6.0f}   {complete} {errors}       {close}")
        lines.append(f"  {_percent(found.unseen)} of all elevations lie in cells that the cameras did not both see")
    if (n := found.navigation) is not None:
        lines += [
            "",
            f"navigation   hazard cells: found {_percent(n['recall'])}, called free {_percent(n['false_safe'])}",
            f"             free cells called hazard {_percent(n['false_alarm'])}; unknown {_percent(n['unknown'])}",
        ]
    if (r := found.rocks) is not None:
        lines.append(
            f"rocks        {r['found']:.0f} of {r['seen']:.0f} seen, 0.2 m or higher, found ({_percent(r['recall'])})"
        )
    if (t := found.tilt) is not None:
        mean, worst = (math.degrees(t[name]) for name in ("mean", "max"))
        lines += ["", f"tilt         mean error {mean:.3f} deg, largest {worst:.3f} deg, over {t['frames']:.0f} frames"]
    return "\n".join(lines)


def _bad(found: dict[str, float], kind: str) -> str:
    return "  ".join(f"bad {t:g} px {_percent(found[f'bad_{t:g}{kind}'])}" for t in measures.BAD_THRESHOLDS)


def _percent(value: float) -> str:
    return "      -" if math.isnan(value) else f"{100 * value:6.2f}%"


def _rotation(quaternion: Any) -> Array:
    xyzw = [quaternion.x, quaternion.y, quaternion.z, quaternion.w]
    return np.asarray(Rotation.from_quat(xyzw).as_matrix())


def _high_rocks(message: Any) -> Array:
    """x, y, diameter (N, 3) of the hazardous rocks of /truth/rocks within the outer ring."""
    offsets = {item.name: item.offset for item in message.fields}
    rows = np.ascontiguousarray(message.data).reshape(message.width, message.point_step)
    x, y, diameter, height = (
        np.ascontiguousarray(rows[:, offsets[name] : offsets[name] + 4]).view("<f4")[:, 0]
        for name in ("x", "y", "diameter", "height")
    )
    high, near = height >= HIGH_ROCK, np.hypot(x, y) <= RINGS[-1][1]
    return np.asarray(np.column_stack([x, y, diameter])[high & near])


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value
