"""Scores a result log against the truth topics of the log that was run.

Results under /nav and truth under /truth are joined by header stamp. Both logs are read side by side, and of a scored
frame only sums are kept. Neither a guess nor silence improves a score: estimates without truth are counted separately,
and a true frame without a result is scored as all unknown.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np

from recordings.containers.opening import open_recording
from recordings.containers.time_range import MAX_LATENESS_NS, TimeRange
from recordings.errors import LogError, sentence_of
from recordings.mcap.file import McapFile, decoded, iter_decoded
from recordings.mcap.input_copy import OWN_FRAME
from recordings.ros2 import from_msg as ros2
from recordings.scoring.contents import (
    cells_of,
    layers_of,
    lens_of,
    mask_of,
    place_of,
    rocks_of,
    rotation_of,
    same_camera,
)  # fmt: skip
from recordings.scoring.metrics import angle_between
from recordings.scoring.pose_metrics import PoseTally
from recordings.scoring.result_log import (
    about_run,
    check_profile,
    is_input,
    part_run,
    span_run,
    stamps_run,
    without_results,
)
from recordings.scoring.side_by_side import Messages, frames
from recordings.scoring.stereo_metrics import StereoErrors, cropped_columns
from recordings.scoring.terrain_metrics import TerrainTally, TrueGround
from recordings.source.topics import attempt
from stages.data import LEVEL_FRAME, Cell

RESULTS = ("/nav/disparity", "/nav/elevation_map", "/nav/navigation_map")
TRUTHS = (
    "/truth/disparity", "/truth/occlusion", "/truth/terrain_class", "/truth/elevation_map", "/truth/navigation_map",
    "/truth/rocks", "/truth/tilt", "/truth/pose",
)  # fmt: skip
MAX_ORIGIN_ERROR = 0.01  # m, of the distance of a map's origin from the camera


@dataclass
class Score:
    """Errors of a run. Shares 0 to 1, lengths m, disparities px, angles rad; NaN if nothing was measured.

    Attributes
    ----------
    frames
        Frames with truth in the part of the log that was run.
    compared
        Frames with a result that was scored.
    missing
        Result topic -> stamps of true frames without it, which are scored as all unknown.
    unmatched
        Result topic -> number of messages at stamps without truth.
    beyond
        True frames outside the part that was run (`run --start`, `--end`, `--every`), which are not scored.
    unscored
        Topic -> reason -> number of frames that have it and cannot be scored.
    other_input
        Whether the log with the truth has images, but other bytes than the input of the run: perhaps another traverse.
    lost
        Log -> reason -> number of unreadable messages. A true frame without one is scored as far as possible.
    disparity
        `StereoErrors.metrics`, cropped by the truth's max_disparity rounded up to 16; by_surface, if the truth has it:
        the metrics of nonocc on sand, gravel, dust and rock.
    terrain
        `TerrainTally.metrics`.
    tilt
        frames, mean and max error.
    untilted
        Reason -> number of frames with a true tilt and none of their own.
    pose
        `PoseTally.metrics`.
    per_frame
        The main metrics of each frame.

    disparity, terrain, tilt and pose are None if the truth has no such topics or no result fits them.
    """

    frames: int = 0
    compared: int = 0
    missing: dict[str, list[int]] = field(default_factory=dict)
    unmatched: dict[str, int] = field(default_factory=dict)
    beyond: int = 0
    unscored: dict[str, dict[str, int]] = field(default_factory=dict)
    other_input: bool = False
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


def score(result: Path, truth: Path | Sequence[Path], whole: bool = True) -> Score:
    """Score a result log.

    Parameters
    ----------
    result
        The log that a run wrote.
    truth
        The log with the truth topics (/truth/...), usually the run's input: a file, several files or a folder.
    whole
        Whether to read all of the truth, to count the frames beyond the part that was run.

    Raises
    ------
    LogError
        If either log has nothing to compare, if their images differ in size, or if the truth is inconsistent.

    Examples
    --------
    >>> from pathlib import Path
    >>> from recordings.scoring.score import score
    >>> score(Path("out.mcap"), Path("traverse.mcap")).disparity["bad_1"]  # doctest: +SKIP
    0.0312
    """
    result, files = Path(result), [Path(truth)] if isinstance(truth, Path | str) else [*map(Path, truth)]
    name = ", ".join(map(str, files))
    check_profile(result, about_run(result))
    with McapFile(result), open_recording(files) as log:
        # without topics that have no message, unless messages were lost
        topics = {channel.topic for n, channel in log.channels.items() if log.count({n}) or log.lost}
        part = TimeRange.after(log.start, *part_run(result, files))
        tally = _Tally(result, name, topics, part, stamps_run(result), span_run(result, files))
        tally.found.other_input = _is_other(result, files, log)
        results = iter_decoded(result, [*RESULTS, "/nav/pose", "/tf"], tally.lost[str(result)])
        lost, near = tally.lost[name], TimeRange() if whole else part.widened(MAX_LATENESS_NS)
        mounts = decoded(log, ["/tf_static"], lost) if near.edges else ()
        truths = chain(mounts, decoded(log, [*TRUTHS, "/tf", "/tf_static"], lost, (near.low, near.high)))
        for stamp, frame in frames(results, tally.noted(truths)):
            if stamp in tally.outside and not frame.keys() & {*RESULTS, "/nav/pose"}:
                tally.found.beyond += 1
                continue
            try:
                tally.add(stamp, frame)
            except (ArithmeticError, LookupError, TypeError, ValueError) as error:
                where = f"{result} or {name} has a message at {stamp} ns"
                raise LogError(f"{where} that cannot be scored: {sentence_of(error)}; record it again") from error
    return tally.score()


class _Tally:
    """Sums up frames, and keeps one row of metrics of each.

    truth: the name of the log with it; truths: its topics; part: of the log that was run; taken: stamps of the frames
    that it took, None for all; span: the first and last of its stamps, None for no limit.
    """

    def __init__(
        self, result: Path, truth: str, truths: set[str], part: TimeRange, taken: set[int] | None,
        span: tuple[int, int] | None,
    ) -> None:  # fmt: skip
        self.result, self.truth, self.truths, self.part, self.taken = result, truth, truths, part, taken
        self.span = span
        self.found = Score()
        self.mounts: dict[str, Any] = {}
        self.distances: dict[str, tuple[float, float]] = {}  # camera -> least and largest distance from base_link, m
        self.fitting = False  # whether a map of any frame was scored
        self.left_out: set[str] = set()  # topics of the current frame
        self.lost: dict[str, Counter[str]] = {log: Counter() for log in (str(result), truth)}
        self.outside: set[int] = set()  # stamps of the truth outside the part that was run
        self.seen_results: set[str] = set()
        self.disparity: StereoErrors | None = None
        self.surfaces: dict[str, StereoErrors] = {}
        self.terrain: TerrainTally | None = None
        self.tilts: list[float] = []
        self.pose = PoseTally()

    def noted(self, messages: Messages) -> Messages:
        """The truth's messages but transforms; notes mounts, and stamps outside the part of the log that was run."""
        for topic, time, message in messages:
            if topic in ("/tf", "/tf_static"):
                if topic == "/tf_static":
                    self.mounts |= {item.child_frame_id: item for item in message.transforms}
                for item in message.transforms:
                    self._note_distances(item)
                continue
            stamp = ros2.stamp_of(message.header)
            left_out = self.taken is not None and stamp not in self.taken
            if self.span is not None:
                left_out |= not self.span[0] <= stamp <= self.span[1]
            if left_out or not self.part.has(stamp, time):
                self.outside.add(stamp)
            yield topic, time, message

    def _note_distances(self, item: Any) -> None:
        """Note how far cameras are from base_link by a transform of its child, such as a mast that turns."""
        above = attempt(ros2.transform_of, item)
        if isinstance(above, LogError) or above.parent != "base_link":
            return
        found = {above.child: float(np.linalg.norm(above.translation))}
        for name, mount in self.mounts.items():
            if mount.header.frame_id == above.child:
                found[name] = float(np.linalg.norm(above(place_of(mount.transform.translation))))
        for name, distance in found.items():
            low, high = self.distances.get(name, (distance, distance))
            self.distances[name] = min(low, distance), max(high, distance)

    def add(self, stamp: int, frame: dict[str, Any]) -> None:
        results = [topic for topic in RESULTS if topic in frame] or [*{"/nav/pose"} & frame.keys()]
        self.seen_results.update(results)
        if not any(topic in frame for topic in TRUTHS):
            for topic in results:
                self.found.unmatched[topic] = self.found.unmatched.get(topic, 0) + 1
            return
        self.found.frames += 1
        self.left_out = set()
        for topic in RESULTS:
            if topic not in frame and topic.replace("/nav/", "/truth/") in frame:
                self.found.missing.setdefault(topic, []).append(stamp)
        row: dict[str, float] = {"stamp": stamp}
        if self._has({"/truth/disparity"}, {"/truth/occlusion"}, frame):
            row |= self._add_disparity(stamp, frame)
        if self._has({"/truth/elevation_map", "/truth/navigation_map"}, {"/truth/rocks"}, frame):
            row |= self._add_terrain(frame)
        if "/truth/tilt" in frame:
            row |= self._add_tilt(frame)
        if "/truth/pose" in frame:
            row |= self._add_pose(frame)
        self.found.compared += not self.left_out.issuperset(results)
        self.found.per_frame.append(row)

    def _has(self, needed: set[str], besides: set[str], frame: dict[str, Any]) -> bool:
        """Whether a frame has the truth topics `needed`, and those of `besides` that the log has.

        This distinguishes a scene without rocks from a lost rock message.
        """
        lacking = (needed | (besides & self.truths)) - frame.keys()
        for topic in sorted(needed & frame.keys()) if lacking else ():
            self._leave_out(topic, f"the truth has no {', '.join(sorted(lacking))} there")
        return not lacking

    def _leave_out(self, topic: str, why: str) -> None:
        self.left_out.add(topic)
        counts = self.found.unscored.setdefault(topic, {})
        counts[why] = counts.get(why, 0) + 1

    def _add_disparity(self, stamp: int, frame: dict[str, Any]) -> dict[str, float]:
        true = ros2.read_disparity(frame["/truth/disparity"])
        given = frame.get("/nav/disparity")
        estimate = ros2.read_disparity(given) if given is not None else np.full_like(true, np.nan)
        if estimate.shape != true.shape:
            raise LogError(
                f"{self.result}: /nav/disparity at {stamp} ns is {estimate.shape[1]}x{estimate.shape[0]}, the truth in "
                f"{self.truth} is {true.shape[1]}x{true.shape[0]}; score a run of that log"
            )
        if given is not None and not same_camera(given, frame["/truth/disparity"]):
            why = f"its camera has {lens_of(given)}, the truth's has {lens_of(frame['/truth/disparity'])}"
            self._leave_out("/nav/disparity", f"{why}: another image, or a wrong calibration")
            return {}
        columns = cropped_columns(frame["/truth/disparity"].max_disparity)
        occlusion, codes = (mask_of(frame, f"/truth/{name}", true.shape) for name in ("occlusion", "terrain_class"))
        errors = StereoErrors.of(estimate, true, occlusion, columns)
        self.disparity = self.disparity + errors if self.disparity else errors
        if codes is not None:
            for name, on_it in StereoErrors.by_surface(estimate, true, occlusion, codes).items():
                self.surfaces[name] = self.surfaces.get(name, StereoErrors()) + on_it
        found = errors.metrics()
        return {f"disparity_{name}": found[name] for name in ("density", "bad_1", "rmse")}

    def _add_terrain(self, frame: dict[str, Any]) -> dict[str, float]:
        true = ros2.read_grid_map(frame["/truth/elevation_map"])
        hazard = cells_of(frame["/truth/navigation_map"], true) == Cell.HAZARD
        rocks = rocks_of(frame["/truth/rocks"]) if "/truth/rocks" in frame else np.zeros((0, 6))
        ground = TrueGround.of(true, hazard, rocks)
        fitting, unfit = dict[str, Any](), dict[str, str]()
        elsewhere = self._elsewhere(frame)
        for topic, read in (("/nav/elevation_map", layers_of), ("/nav/navigation_map", cells_of)):
            try:
                if topic in frame and elsewhere:
                    unfit[topic] = elsewhere
                elif topic in frame:
                    fitting[topic] = read(frame[topic], true)
            except ValueError as error:
                unfit[topic] = str(error)
        if unfit:
            for topic, why in (unfit | dict.fromkeys(fitting, "the frame's other map does not fit the truth")).items():
                self._leave_out(topic, why)
            return {}
        self.fitting |= bool(fitting)
        self.terrain = self.terrain or TerrainTally()
        return self.terrain.add(ground, fitting.get("/nav/elevation_map", {}), fitting.get("/nav/navigation_map"))

    def _elsewhere(self, frame: dict[str, Any]) -> str:
        """Why the maps of a frame have another origin than base_link, as those of the truth have; empty if unknown."""
        for item in frame.get("/tf", ()):
            name = item.child_frame_id.removeprefix(OWN_FRAME)
            if name in self.mounts and name in self.distances:
                found = float(np.linalg.norm(place_of(item.transform.translation)))
                true = float(np.clip(found, *self.distances[name]))
                if abs(found - true) > MAX_ORIGIN_ERROR:
                    return f"its origin is {found:.2f} m from the camera, the truth's (base_link) {true:.2f} m"
        return ""

    def _add_pose(self, frame: dict[str, Any]) -> dict[str, float]:
        """The errors of a pose, if it is of the truth's body."""
        true, given = frame["/truth/pose"], frame.get("/nav/pose")
        if given is not None and given.child_frame_id != true.child_frame_id:
            self._leave_out("/nav/pose", f"it is of '{given.child_frame_id}', the truth's of '{true.child_frame_id}'")
            return {}
        return self.pose.add(true, given)

    def _add_tilt(self, frame: dict[str, Any]) -> dict[str, float]:
        """The tilt's error, by the camera that the truth knows. Viewers' pictures are children of frame `level` too."""
        placed = {item.child_frame_id.removeprefix(OWN_FRAME): item for item in frame.get("/tf", ())}
        true = frame["/truth/tilt"]
        body, true_up = true.header.frame_id, rotation_of(true.quaternion)[2]  # up is in the axes of its header
        mounts = {name: mount for name, mount in self.mounts.items() if mount.header.frame_id == body}
        camera = next((name for name in placed if name == body or name in mounts), None)
        if camera is not None:
            if camera != body:
                true_up = true_up @ rotation_of(mounts[camera].transform.rotation)
            # Gravity's opposite in camera axes is independent of the heading.
            self.tilts.append(angle_between(rotation_of(placed[camera].transform.rotation)[2], true_up))
            return {"tilt": self.tilts[-1]}
        if placed:
            self._leave_out("/tf", f"the truth has no mount of '{next(iter(placed))}' on '{body}'")
        else:
            why = f"the result has no /tf from '{LEVEL_FRAME}' at that stamp"
            self.found.untilted[why] = self.found.untilted.get(why, 0) + 1
        return {}

    def score(self) -> Score:
        """The score. Raises LogError if there was nothing to compare."""
        found = self.found
        if not found.frames:
            damage = "".join(f" ({why})" for why in islice(self.lost[self.truth], 1))
            raise LogError(
                f"{self.truth} has no ground truth (/truth/...){damage}; give the log that has it with --truth"
            )
        if not self.seen_results:
            raise without_results(self.result, RESULTS)
        if not found.compared:
            misfits = [f"{topic}: {why}" for topic, whys in found.unscored.items() for why in whys]
            if misfits:
                raise LogError(f"{self.result}: no result fits the truth in {self.truth}: {misfits[0]}")
            raise LogError(f"no result in {self.result} has a stamp of {self.truth}; score a run of that log")
        found.missing = {topic: found.missing[topic] for topic in RESULTS if topic in found.missing}
        found.lost = {log: dict(why) for log, why in self.lost.items() if why}
        if self.disparity is not None:
            surfaces = {name: errors.metrics()["whole_image"]["nonocc"] for name, errors in self.surfaces.items()}
            found.disparity = self.disparity.metrics() | ({"by_surface": surfaces} if surfaces else {})
        if self.terrain and (self.fitting or not found.unscored.keys() & {*RESULTS[1:]}):
            found.terrain = self.terrain.metrics()
        if tilts := self.tilts:
            found.tilt = {"frames": len(tilts), "mean": float(np.mean(tilts)), "max": max(tilts)}
        found.pose = self.pose.metrics()
        return found


def _is_other(result: Path, files: Sequence[Path], log: Any) -> bool:
    """Whether an opened log has images, but other bytes than the input of a result log. files: its."""
    about = about_run(result)
    has_images = any(
        channel.schema is not None and channel.schema.name.endswith("Image") and not channel.topic.startswith("/truth/")
        for channel in log.channels.values()
    )
    return has_images and "log_digest" in about and [*files] != [result] and not is_input(about, files)


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value
