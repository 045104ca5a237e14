"""A run's output log against the truth topics of the log it ran on: one table of errors.

Results under /nav and truth under /truth meet by header stamp. Both logs are read side by side in time and a frame
is scored, and forgotten but for its sums, as soon as neither can add to it. Errors are told for what both cameras saw
and for what one did; values given where there is no truth are counted on their own, and a true frame that the run left
out is scored as one of which it knew nothing, so that neither a guess nor silence passes for knowledge.
"""

from __future__ import annotations

import heapq
import json
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from recordings.errors import LogError, sentence_of
from recordings.mcap.file import McapFile, iter_decoded
from recordings.ros2 import from_msg as ros2
from recordings.scoring import metrics as measures
from recordings.scoring import terrain_metrics as terrain_measures
from recordings.scoring.pose_metrics import PoseTally
from recordings.scoring.result_log import part_run, without_results
from recordings.scoring.stereo_metrics import StereoErrors, cropped_columns
from recordings.source.log import is_within, part_of
from stages.data import LEVEL_FRAME, Array, Cell, ElevationMap, NavigationMap

RESULTS = ("/nav/disparity", "/nav/elevation_map", "/nav/navigation_map")
TRUTHS = (
    "/truth/disparity", "/truth/occlusion", "/truth/elevation_map", "/truth/navigation_map", "/truth/rocks",
    "/truth/tilt", "/truth/pose",
)  # fmt: skip
PATIENCE = 5_000_000_000  # ns of log time after which no log adds to a frame any more
ALIKE = 1e-3  # of the focal length or baseline; cameras that differ by less see alike
FIRST = 9  # stamps that tell how far the clock of the logging is from theirs


@dataclass(frozen=True)
class Score:
    """Errors of a run. Shares 0 to 1, lengths m, disparities px, angles rad; NaN where there was nothing to measure.

    frames: in the truth of the part that was run; compared: those with a result that was scored; missing: result topic
    -> stamps of true frames that it lacks, which are scored as all unknown; unmatched: result topic -> messages at
    stamps without truth; beyond: true frames outside that part (`run --start`, `--end`), which do not count;
    unscored: topic -> why -> frames that have it and cannot be scored;
    lost: log -> why -> messages that could not be read; a true frame that lacks one is scored as far as it goes;
    disparity: `StereoErrors.measures`, cropped by the truth's max_disparity (the data set's range where it has one,
    else the frame's largest), rounded up to 16;
    terrain: `terrain_measures.TerrainTally.measures`;
    tilt: frames, mean, max; untilted: why -> frames with a true tilt whose own could not be scored;
    pose: `PoseTally.measures`; per_frame: the main figures of each frame.
    None where the truth has no such topics, or nothing of the result fits them (tilt: where no frame has both).
    """

    frames: int
    compared: int
    missing: dict[str, list[int]]
    unmatched: dict[str, int]
    beyond: int = 0
    unscored: dict[str, dict[str, int]] = field(default_factory=dict)
    lost: dict[str, dict[str, int]] = field(default_factory=dict)
    disparity: dict[str, Any] | None = None
    terrain: dict[str, Any] | None = None
    tilt: dict[str, float] | None = None
    untilted: dict[str, int] = field(default_factory=dict)
    pose: dict[str, float] | None = None
    per_frame: list[dict[str, float]] = field(default_factory=list)

    def to_json(self) -> str:
        """JSON text; NaN becomes null."""
        return json.dumps(_without_nan(asdict(self)), indent=2, allow_nan=False)


def score(result: Path, truth: Path) -> Score:
    """Compare the log `result` of a run with the truth topics of the log `truth`.

    Raises LogError where either has nothing to compare, where their images do not fit, or the truth's own maps.
    """
    tally = _Tally(Path(result), Path(truth))
    for stamp, frame in _frames(Path(result), Path(truth), tally):
        if stamp in tally.outside and not frame.keys() & {*RESULTS}:
            tally.beyond += 1
            continue
        try:
            tally.add(stamp, frame)
        except (ArithmeticError, LookupError, TypeError, ValueError) as error:
            where = f"{result} or {truth} holds something at {stamp} ns"
            raise LogError(f"{where} that cannot be scored: {sentence_of(error)}; record it again") from error
    return tally.score()


def _frames(result: Path, truth: Path, tally: _Tally) -> Iterator[tuple[int, dict[str, Any]]]:
    """(stamp, {topic: message}) of all frames of both logs, each when it is complete."""
    streams = [
        _on_their_clock(iter_decoded(result, [*RESULTS, "/nav/pose", "/tf"], tally.lost[str(result)])),
        _on_their_clock(tally.noted(iter_decoded(truth, [*TRUTHS, "/tf_static"], tally.lost[str(truth)]))),
    ]
    waiting: dict[int, dict[str, Any]] = {}
    for topic, time, message in heapq.merge(*streams, key=lambda item: item[1]):
        if topic in ("/tf", "/tf_static"):
            for item in message.transforms:
                if topic == "/tf_static":
                    tally.mounts[item.child_frame_id] = item
                elif item.header.frame_id == LEVEL_FRAME:
                    waiting.setdefault(ros2.stamp_of(item.header), {})["/tf"] = item
            continue
        waiting.setdefault(ros2.stamp_of(message.header), {})[topic] = message
        for stamp in [stamp for stamp in waiting if stamp < time - PATIENCE]:
            yield stamp, waiting.pop(stamp)
    for stamp in sorted(waiting):
        yield stamp, waiting.pop(stamp)


def _on_their_clock(messages: Iterator[tuple[str, int, Any]]) -> Iterator[tuple[str, int, Any]]:
    """The messages with the times of their logging on the clock of their stamps: what is recorded of a simulator is
    often logged by another one. The middle one of the first stamps tells how far apart the two are."""
    read, ahead = list[tuple[str, int, Any]](), list[int]()
    for message in messages:
        read.append(message)
        if hasattr(message[2], "header"):
            ahead.append(message[1] - ros2.stamp_of(message[2].header))
        if len(ahead) == FIRST:
            break
    apart = sorted(ahead)[len(ahead) // 2] if ahead else 0
    yield from ((topic, time - apart, found) for topic, time, found in chain(read, messages))


class _Tally:
    """Sums up frames; of a frame it keeps one row of figures, whatever the size of its images and maps."""

    def __init__(self, result: Path, truth: Path) -> None:
        self.result, self.truth = result, truth
        self.mounts: dict[str, Any] = {}
        self.frames = self.compared = self.beyond = 0
        self.missing: dict[str, list[int]] = {topic: [] for topic in RESULTS}
        self.unmatched: dict[str, int] = {}
        self.unscored: dict[str, dict[str, int]] = {}
        self.fitting = False  # whether a map of any frame could be scored
        self.left_out: set[str] = set()  # topics, of the frame that is being added
        self.lost: dict[str, Counter[str]] = {str(log): Counter() for log in (result, truth)}
        with McapFile(truth) as log:  # recorders note topics of which no message came; of a damaged log, some may have
            channels = log.index.channels
            self.truths = {channels[number].topic for number in channels if log.count({number}) or log.index.lost}
            with McapFile(result):  # or why that is none
                self.part = part_of(log.start, *part_run(result, truth))
        self.outside: set[int] = set()  # stamps of the truth there, in the log that was run
        self.seen_results: set[str] = set()
        self.disparity: StereoErrors | None = None
        self.terrain: terrain_measures.TerrainTally | None = None
        self.tilts: list[float] = []
        self.untilted: dict[str, int] = {}
        self.pose = PoseTally()
        self.per_frame: list[dict[str, float]] = []

    def noted(self, messages: Iterator[tuple[str, int, Any]]) -> Iterator[tuple[str, int, Any]]:
        """The truth's messages; takes note of the stamps of those outside the part of the log that was run."""
        for topic, time, message in messages:
            if topic in TRUTHS and not is_within(ros2.stamp_of(message.header), time, *self.part):
                self.outside.add(ros2.stamp_of(message.header))
            yield topic, time, message

    def add(self, stamp: int, frame: dict[str, Any]) -> None:
        results = [topic for topic in RESULTS if topic in frame]
        self.seen_results.update(results)
        if not any(topic in frame for topic in TRUTHS):
            for topic in results:
                self.unmatched[topic] = self.unmatched.get(topic, 0) + 1
            return
        self.frames += 1
        self.left_out = set()
        for topic in RESULTS:
            if topic not in frame and topic.replace("/nav/", "/truth/") in frame:
                self.missing[topic].append(stamp)
        row: dict[str, float] = {"stamp": stamp}
        if self._has({"/truth/disparity"}, {"/truth/occlusion"}, frame):
            row |= self._add_disparity(stamp, frame)
        if self._has({"/truth/elevation_map", "/truth/navigation_map"}, {"/truth/rocks"}, frame):
            row |= self._add_terrain(stamp, frame)
        if "/truth/tilt" in frame:
            row |= self._add_tilt(frame)
        if "/truth/pose" in frame:
            row |= self.pose.add(frame["/truth/pose"], frame.get("/nav/pose"))
        self.compared += not self.left_out.issuperset(results)
        self.per_frame.append(row)

    def _has(self, needed: set[str], besides: set[str], frame: dict[str, Any]) -> bool:
        """Whether a frame has the truth `needed`, and `besides` what the log has of this: no rocks there were is one
        thing, rocks that were lost another."""
        lacking = (needed | (besides & self.truths)) - frame.keys()
        for topic in sorted(needed & frame.keys()) if lacking else ():
            self._leave_out(topic, f"the truth has no {', '.join(sorted(lacking))} there")
        return not lacking

    def _leave_out(self, topic: str, why: str) -> None:
        self.left_out.add(topic)
        counts = self.unscored.setdefault(topic, {})
        counts[why] = counts.get(why, 0) + 1

    def _add_disparity(self, stamp: int, frame: dict[str, Any]) -> dict[str, float]:
        true = ros2.read_disparity(frame["/truth/disparity"])
        given = frame.get("/nav/disparity")
        estimate = ros2.read_disparity(given) if given is not None else np.full_like(true, np.nan)
        if estimate.shape != true.shape:
            raise LogError(
                f"{self.result}: /nav/disparity at {stamp} ns is {estimate.shape[1]}x{estimate.shape[0]}, the truth in "
                f"{self.truth} is {true.shape[1]}x{true.shape[0]}; score a run of that very log"
            )
        if given is not None and not _alike(given, frame["/truth/disparity"]):
            why = f"{_lens(given)}, the truth's has {_lens(frame['/truth/disparity'])}: they are not of the same image"
            self._leave_out("/nav/disparity", f"its camera has {why}")
            return {}
        columns = cropped_columns(frame["/truth/disparity"].max_disparity)
        errors = StereoErrors.of(estimate, true, self._occlusion(stamp, frame, true.shape), columns)
        self.disparity = self.disparity + errors if self.disparity else errors
        found = errors.measures()
        return {f"disparity_{name}": found[name] for name in ("density", "bad_1", "rmse")}

    def _occlusion(self, stamp: int, frame: dict[str, Any], shape: tuple[int, ...]) -> Array | None:
        mask = frame.get("/truth/occlusion")
        if mask is None:
            return None
        if (mask.height, mask.width) != shape:
            raise LogError(
                f"{self.truth}: /truth/occlusion at {stamp} ns is {mask.width}x{mask.height}, /truth/disparity is "
                f"{shape[1]}x{shape[0]}; make the truth again"
            )
        return np.asarray(mask.data).reshape(mask.height, mask.step)[:, : mask.width]

    def _add_terrain(self, stamp: int, frame: dict[str, Any]) -> dict[str, float]:
        true = ros2.read_grid_map(frame["/truth/elevation_map"])
        try:
            hazard = _cells(frame["/truth/navigation_map"], true) == Cell.HAZARD
        except ValueError as error:
            where = f"{self.truth}: /truth/navigation_map at {stamp} ns"
            raise LogError(f"{where}: {error}; make the truth again") from error
        rocks = _rocks(frame["/truth/rocks"]) if "/truth/rocks" in frame else np.zeros((0, 6))
        ground = terrain_measures.TrueGround.of(true, hazard, rocks)
        if ground is None:
            raise LogError(f"{self.truth}: /truth at {stamp} ns lacks what maps are scored with; make the truth again")
        fitting, unfit = dict[str, Any](), dict[str, str]()
        for topic, read in (("/nav/elevation_map", _layers), ("/nav/navigation_map", _cells)):
            try:
                if topic in frame:
                    fitting[topic] = read(frame[topic], true)
            except ValueError as error:
                unfit[topic] = str(error)
        if unfit:
            for topic, why in (unfit | dict.fromkeys(fitting, "the frame's other map does not fit the truth")).items():
                self._leave_out(topic, why)
            return {}
        self.fitting |= bool(fitting)
        self.terrain = self.terrain or terrain_measures.TerrainTally()
        return self.terrain.add(ground, fitting.get("/nav/elevation_map", {}), fitting.get("/nav/navigation_map"))

    def _add_tilt(self, frame: dict[str, Any]) -> dict[str, float]:
        item, true = frame.get("/tf"), frame["/truth/tilt"]
        mount = None if item is None else self.mounts.get(item.child_frame_id)
        if item is None:
            why = f"the result has no /tf from '{LEVEL_FRAME}' at their stamps"
        elif mount is None or mount.header.frame_id != true.header.frame_id:
            why = f"the truth has no mount of '{item.child_frame_id}' on '{true.header.frame_id}'"
        else:
            base_from_camera = _rotation(mount.transform.rotation)
            # Gravity's opposite in camera axes: heading does not enter.
            true_up = (_rotation(true.quaternion) @ base_from_camera)[2]
            self.tilts.append(measures.angle_between(_rotation(item.transform.rotation)[2], true_up))
            return {"tilt": self.tilts[-1]}
        self.untilted[why] = self.untilted.get(why, 0) + 1
        return {}

    def score(self) -> Score:
        """The tally as a score; LogError if there was nothing to compare."""
        if not self.frames:
            damage = "".join(f", as {why}" for why in islice(self.lost[str(self.truth)], 1))
            raise LogError(
                f"{self.truth} has no ground truth (/truth/...){damage}; give the log that has it with --truth"
            )
        if not self.seen_results:
            raise without_results(self.result, RESULTS)
        if not self.compared:
            misfits = [f"of {topic}, {why}" for topic in RESULTS for why in self.unscored.get(topic, ())]
            if misfits:
                raise LogError(f"{self.result}: nothing in it fits the truth in {self.truth}: {misfits[0]}")
            raise LogError(f"no result of {self.result} has the stamp of a true frame of {self.truth}; is it its run?")
        tilts, unfit = self.tilts, not self.fitting and bool(self.unscored.keys() & {*RESULTS[1:]})
        return Score(
            self.frames, self.compared,
            missing={topic: stamps for topic, stamps in self.missing.items() if stamps},
            unmatched=self.unmatched,
            beyond=self.beyond,
            unscored=self.unscored,
            lost={log: dict(why) for log, why in self.lost.items() if why},
            disparity=self.disparity.measures() if self.disparity else None,
            terrain=self.terrain.measures() if self.terrain and not unfit else None,
            tilt={"frames": len(tilts), "mean": float(np.mean(tilts)), "max": max(tilts)} if tilts else None,
            untilted=self.untilted,
            pose=self.pose.measures(),
            per_frame=self.per_frame,
        )  # fmt: skip


def _layers(message: Any, onto: ElevationMap) -> dict[str, Array]:
    """What is scored of a GridMap, in the cells of `onto`. Raises ValueError where it does not fit."""
    grid = ros2.read_grid_map(message)
    wanted = sorted(grid.layers.keys() & {"elevation", "variance", "common_variance"})
    return {name: _fitted(grid, grid.layers[name], onto, np.nan) for name in wanted}


def _cells(message: Any, onto: ElevationMap) -> Array:
    """The cells of an OccupancyGrid, in the cells of `onto`. Raises ValueError where it does not fit."""
    grid = ros2.read_occupancy_grid(message)
    return _fitted(grid, grid.cells, onto, Cell.UNKNOWN)


def _fitted(grid: ElevationMap | NavigationMap, values: Array, onto: ElevationMap, missing: float) -> Array:
    if abs(grid.resolution - onto.resolution) > 1e-4 * onto.resolution:
        cells = f"its cells are {grid.resolution:g} m wide, the truth's {onto.resolution:g} m"
        raise ValueError(f"{cells}; run with that resolution")
    if grid.frame_id != onto.frame_id:
        raise ValueError(f"it is in frame '{grid.frame_id}', the truth in '{onto.frame_id}'")
    return measures.aligned(values, grid.origin, onto.shape, onto.origin, onto.resolution, missing)


def _alike(one: Any, other: Any) -> bool:
    """Whether two DisparityImages are of cameras with one focal length and baseline, as far as both tell."""
    ours, theirs = (one.f, one.t), (other.f, other.t)
    told = min(*ours, *theirs) > 0  # neither NaN nor left out
    return not told or np.allclose(ours, theirs, rtol=ALIKE, atol=0)


def _lens(disparity: Any) -> str:
    return f"f = {disparity.f:.6g} px and a baseline of {disparity.t:.4g} m"


def _rotation(quaternion: Any) -> Array:
    xyzw = [quaternion.x, quaternion.y, quaternion.z, quaternion.w]
    return np.asarray(Rotation.from_quat(xyzw).as_matrix())


def _rocks(message: Any) -> Array:
    """x, y, diameter, height, m, and, where told, pixels and shown, of /truth/rocks (all within 10 m of base_link)."""
    fields = ros2.read_point_cloud(message)
    names = ("x", "y", "diameter", "height", "pixels", "shown")
    return np.column_stack([fields[name] for name in names if name in fields])


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value
