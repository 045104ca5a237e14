"""Writes the streams of a pipeline into an MCAP log, as ROS 2 messages, one set per frame.

All messages of a frame have its stamp as log time, so results line up with the input log. The log contains no times of
day and no durations: equal runs give equal bytes.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from flow.contracts import FrameRecord, Loss
from flow.parameters import check_parameters, parameter, set_by_run
from recordings.mcap.input_copy import copy_inputs, parents_in
from recordings.mcap.writer import COMPRESSIONS, Ros2Writer, Written
from recordings.ros2.plain import message_of
from recordings.ros2.to_msg import (
    diagnostics,
    disparity_camera,
    disparity_image,
    grid_map,
    occupancy_grid,
    odometry,
    point_cloud,
    reason_map,
    source_image,
    transform_message,
)
from recordings.sinks.map_cropping import cropped
from recordings.sinks.overwrite import refuse_foreign
from recordings.sinks.own_types import leaves, plain_type, refusal
from recordings.sinks.thinning import thinned
from recordings.sinks.viewer_topics import beside_inputs, rerun_root, viewer_messages
from stages.data import (
    LEVEL_FRAME,
    Disparity,
    ElevationMap,
    NavigationMap,
    PointCloud,
    Pose,
    Region,
    StereoFrame,
    TiltHealth,
    Transform,
)  # fmt: skip

_KNOWN = (Disparity, PointCloud, ElevationMap, NavigationMap, Pose, Transform)
_OK, _WARN, _ERROR = 0, 1, 2  # levels of diagnostic_msgs/DiagnosticStatus
_REMEMBERED = ("_owners", "_rooted", "_last_stamp", "empty")
_COUNTS = ("verdict", "interrupted", "pipeline", "frames_in", "frames_out")


@dataclass
class McapSink:
    """Writes streams to /nav/<stream>, transforms to /tf, and losses, tilt health and findings to /nav/diagnostics.

    docs/writing-a-stage.md lists the forms of all types of items. A stream of a type without one is refused when the
    pipeline is loaded.

    Examples
    --------
    >>> from recordings import McapSink
    >>> sink = McapSink(also=("sharpness",))
    >>> sink.wants("sharpness", float), sink.wants("blur", float)
    (True, False)
    >>> sink.unwritable("sharpness", complex)
    "McapSink cannot write 'sharpness': complex has no standard form; leave it out of 'also'"
    """

    results: tuple[str, ...] = parameter(
        ("disparity", "points", "elevation_map", "navigation_map", "pose", "regional_map", "regional_navigation_map"),
        "streams to write; without any of them the run writes no log",
    )
    also: tuple[str, ...] = parameter((), "further streams to write")
    disparity_step: float = parameter(
        1 / 32, "rounding step of disparities, which saves two thirds of the space; 0: exact", unit="px", low=0, high=1
    )
    point_spacing: float = parameter(
        0.02, "side of cubes that keep only their first point; 0: all points", unit="m",
        low=0, high=10,
    )  # fmt: skip
    length_step: float = parameter(
        1 / 1024, "rounding step of map heights and point coordinates; 0: exact", unit="m", low=0, high=1
    )
    precision: float = parameter(
        0.01, "largest relative rounding error of variances, slopes, roughness and sigmas; 0: exact", low=0,
        high=0.1,
    )  # fmt: skip
    viewers: bool = parameter(
        False, "also write depth, left image, coloured terrain and coloured codes, which viewers draw without plugins"
    )
    compression: str = parameter(
        "lz4", "compression; zstd takes a third less space than lz4 and twice the time", choices=tuple(COMPRESSIONS)
    )

    profile: str = parameter(
        "ros2",
        "message types; Foxglove draws its own without extensions; score, export, diff and report read only ros2",
        choices=("ros2", "foxglove"),
    )  # fmt: skip

    inputs: tuple[str, ...] = set_by_run(())  # logs that are copied beside the results

    suffix = ".mcap"
    names_streams: ClassVar[tuple[str, ...]] = ("results", "also")
    _writer: Ros2Writer = field(init=False, repr=False)
    _kinds: Mapping[str, Any] = field(default_factory=dict, init=False, repr=False)
    _owners: dict[str, str] = field(default_factory=dict, init=False, repr=False)
    _about: Mapping[str, str] = field(default_factory=dict, init=False, repr=False)
    _theirs: Mapping[str, str] = field(default_factory=dict, init=False, repr=False)  # frame -> parent in the input
    _rooted: bool = field(default=False, init=False, repr=False)
    _last_stamp: int | None = field(default=None, init=False, repr=False)
    empty: bool = field(default=True, init=False, repr=False)  # whether none of the streams to write had an item

    def __post_init__(self) -> None:
        check_parameters(self)

    def wants(self, stream: str, kind: Any) -> bool:
        """Whether the sink writes a stream of this name and type, or takes transforms or diagnostics from it."""
        plain = plain_type(kind)
        used = (TiltHealth, Region, PointCloud, *([StereoFrame] if self.viewers else []))
        return stream in self._written or (isinstance(plain, type) and issubclass(plain, used))

    def unwritable(self, stream: str, kind: Any) -> str:
        """Why the sink cannot write a stream that it is to write, in a sentence; empty where it can."""
        if stream not in self._written:
            return ""
        if stream.partition("/")[0] == "diagnostics":
            return f"McapSink cannot write '{stream}': /nav/diagnostics contains the losses; rename the stream"
        setting = "results" if stream in self.results else "also"
        why = refusal(kind, _KNOWN)
        return f"McapSink cannot write '{stream}': {why}; leave it out of '{setting}'" if why else ""

    def open(self, path: Path, streams: Mapping[str, type], about: Mapping[str, str]) -> None:
        """Start the log. about: facts of the run, kept as the metadata record "roverflow"."""
        refuse_foreign(path, "result log")
        self._rooted, self._last_stamp, self.empty = False, None, True
        self._kinds, self._owners, self._about = dict(streams), {}, about
        self._theirs = parents_in([Path(log) for log in self.inputs]) if self.inputs else {}
        self._writer = self._writer_class()(Path(path), keep=True, compression=self.compression, digests=True)
        try:
            own = {"profile": self.profile, "with_inputs": "yes" if self.inputs else ""}
            own = {name: value for name, value in own.items() if value not in ("ros2", "")}
            self._writer.metadata("roverflow", {**about, **own})
            self._writer.attachment("pipeline.yaml", "application/yaml", _as_ran(about).encode())
        except BaseException:
            self._writer.abort()
            raise

    def write(self, record: FrameRecord) -> dict[str, str]:
        """Write a frame. Returns why streams, or parts of them, have no message in it."""
        writer, stamp = self._writer, record.stamp
        kept = {name: record.items[name] for name in self._written if name in record.items}
        lost = self._write_items(kept, stamp)
        own = {(known.parent, known.child): known for known in _transforms(record.items.values(), stamp)}
        regional = any(plain_type(kind) is Region for kind in self._kinds.values())
        if transforms := beside_inputs([*own.values()], self._theirs, regional):
            writer.write("/tf", transform_message((known, stamp) for known in transforms), stamp)
            root = rerun_root(transforms, self._theirs)
            if self.viewers and not self._rooted and not (regional and root.child == LEVEL_FRAME):
                self._rooted = True
                writer.write("/tf_static", transform_message([(root, stamp)]), stamp)
        if self.viewers:
            taken = {known.child for known in own.values()} & self._theirs.keys()
            for topic, message in viewer_messages(record.items, kept, taken):
                writer.write(topic, message, stamp)
        health = [_health(name, item) for name, item in record.items.items() if isinstance(item, TiltHealth)]
        maps = [(name, record.items.get(name)) for name in self._written]
        epochs = [
            _epoch(name, item) for name, item in maps if isinstance(item, ElevationMap) and item.epoch is not None
        ]
        statuses = [*_statuses(record.entries), *health, *epochs]
        writer.write("/nav/diagnostics", diagnostics(stamp, statuses), stamp)
        writer.flush()  # so that a resumed log has the same bytes
        self._last_stamp = stamp
        return lost

    def checkpoint(self) -> tuple[Written, dict[str, Any]]:
        """What the log contains by now, and what the sink remembers of it."""
        return self._writer.written(), {name: getattr(self, name) for name in _REMEMBERED}

    def resume(self, saved: tuple[Written, dict[str, Any]]) -> None:
        """Continue the log of a checkpoint, after `open`. Raises LogError if its messages are not all there."""
        written, remembered = saved
        self._writer.continue_from(written)
        for name, value in remembered.items():
            setattr(self, name, value)

    def close(self, summary: Mapping[str, Any]) -> None:
        """Finish the log. summary: of the run: losses after the last frame ("entries"), verdict and counts."""
        writer = self._writer
        if writer.closed:  # a write failed and raised
            return
        entries = list(summary.get("entries", ()))
        found = [*summary.get("surveys", {}).items(), *summary.get("findings", {}).items()]
        findings = [_finding(stream, finding) for stream, finding in found] + self._copied_inputs()
        if entries or (findings and self._last_stamp is not None):
            latest = max([0, *(entry.stamp for entry in entries)])
            stamp = latest if self._last_stamp is None else self._last_stamp
            lost = _statuses(entries) if entries else []
            writer.write("/nav/diagnostics", diagnostics(stamp, [*lost, *findings]), stamp)
        counts = {name: str(summary[name]) for name in _COUNTS if name in summary}
        for group in ("drops", "messages"):
            counts |= {f"{group}.{name}": str(count) for name, count in summary.get(group, {}).items()}
        for stream, finding in found:
            counts[f"findings.{stream}"] = f"{finding['severity']}: {finding['sentence']}"
        writer.metadata("roverflow.run", counts)
        writer.metadata("roverflow.digests", writer.digests())
        writer.close()

    def discard(self) -> None:
        """Discard the log; an earlier file of its name stays."""
        self._writer.abort()

    def _copied_inputs(self) -> list[tuple[int, str, str, dict[str, str]]]:
        """Copy the input logs; returns the diagnostic status of each reason why messages could not be copied."""
        if not self.inputs:
            return []
        start, end = (float(text) if (text := self._about.get(name)) else None for name in ("start", "end"))
        lost = copy_inputs(self._writer, [Path(log) for log in self.inputs], start, end)
        return [(_WARN, "inputs", f"not copied: {why}", {"times": str(times)}) for why, times in lost.items()]

    def _writer_class(self) -> type[Ros2Writer]:
        if self.profile == "ros2":
            return Ros2Writer
        from recordings.foxglove.writer import FoxgloveWriter  # which takes a tenth of a second to load

        return FoxgloveWriter

    @property
    def _written(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys((*self.results, *self.also)))

    def _write_items(self, items: Mapping[str, Any], stamp: int) -> dict[str, str]:
        """Write streams of a frame; returns the parts without a message -> why."""
        lost = dict[str, str]()
        for stream, item in cropped(items).items():
            try:
                parts = [*leaves(item, self._kinds.get(stream, type(item)), _KNOWN)]
            except ValueError as error:
                parts, lost[stream] = [], str(error)
            for path, leaf in parts:
                name = "/".join((stream, *path))
                topic = "/".join(["/nav", stream, *map(_topic_part, path)])
                try:
                    for below, message in self._built(leaf, stamp, str(getattr(item, "frame_id", ""))).items():
                        self._write_message(topic + below, name, message, stamp)
                except ValueError as error:
                    lost[name] = str(error)
        return lost

    def _write_message(self, topic: str, name: str, message: Any, stamp: int) -> None:
        """Write a message of the stream or part of this name."""
        owner = self._owners.setdefault(topic, name)
        if owner != name:
            raise ValueError(f"its topic {topic} is that of '{owner}'; rename one")
        self._writer.write(topic, message, stamp)
        self.empty = False

    def _built(self, leaf: Any, stamp: int, frame_id: str) -> dict[str, Any]:
        """The messages of a value, by the part of their topic below that of the stream."""
        match leaf:
            case Disparity():
                image = disparity_image(leaf, self.disparity_step)
                return {"": image, "/source": source_image(leaf)} | disparity_camera(leaf)
            case PointCloud():
                return {"": point_cloud(thinned(leaf, self.point_spacing), self.length_step, self.precision)}
            case ElevationMap():
                return {"": grid_map(leaf, self.length_step, self.precision)}
            case NavigationMap():  # an OccupancyGrid has no room for the reasons
                return {"": occupancy_grid(leaf), "/reason": reason_map(leaf)}
            case Pose():
                return {"": odometry(leaf)}
            case _:
                return {"": message_of(leaf, stamp, frame_id)}


def _as_ran(about: Mapping[str, str]) -> str:
    """The pipeline file of a run, with the changes of the command line as comments."""
    changes = "".join(f"# --set {change}\n" for change in about.get("overrides", "").splitlines())
    return changes + about.get("pipeline", "")


def _topic_part(name: str) -> str:
    """A name as part of a topic: letters, digits and underscores, no digit first."""
    return re.sub(r"^(?=\d|$)", "_", re.sub(r"[^A-Za-z0-9_]", "_", name))


def _transforms(items: Iterable[Any], stamp: int) -> Iterator[Transform]:
    """The poses of the sensors of clouds, and of frame `level` in regions and in maps, of a stamp."""
    for item in items:
        if getattr(item, "stamp", stamp) != stamp:  # the map of an earlier frame, where the region begins again
            continue
        known = item.sensor if isinstance(item, PointCloud) else getattr(item, "level", None)
        if isinstance(known, Transform):  # a type of the user's own may have another `level`
            yield known


def _finding(stream: str, finding: Mapping[str, str]) -> tuple[int, str, str, dict[str, str]]:
    """The diagnostic status of a finding of the run."""
    level = {"warning": _WARN, "fault": _ERROR}.get(finding["severity"], _OK)
    return level, stream, finding["sentence"], {"finding": finding["sentence"], "severity": finding["severity"]}


def _epoch(stream: str, terrain: ElevationMap) -> tuple[int, str, str, dict[str, str]]:
    """The diagnostic status of a regional map: the stamp from which its layers "first" and "last" count."""
    text = f"layers first and last count seconds from {terrain.epoch} ns"
    return _OK, stream, text, {"epoch": str(terrain.epoch)}


def _health(stream: str, health: TiltHealth) -> tuple[int, str, str, dict[str, str]]:
    """The diagnostic status of a tilt's health."""
    angles = {"tilt off turn": health.turn, "ground off level": health.ground}
    values = {name: f"{math.degrees(angle):.3f} deg" for name, angle in angles.items() if math.isfinite(angle)}
    values |= {"frames": str(health.frames), "fault": health.fault}
    return _WARN if health.fault else _OK, stream, health.judgement, values


def _statuses(entries: Iterable[Loss]) -> list[tuple[int, str, str, dict[str, str]]]:
    """The diagnostic status of each loss, or a single one if there is none."""
    statuses = [
        (
            _ERROR, f"{entry.stage}/{entry.stream}", entry.detail,
            {"reason": str(entry.reason), "stream": entry.stream, "stage": entry.stage, "stamp": str(entry.stamp)},
        )
        for entry in entries
    ]  # fmt: skip
    return statuses or [(_OK, "roverflow", "nothing lost", {})]
