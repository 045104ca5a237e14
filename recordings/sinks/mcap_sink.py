"""Writes what a pipeline made into an MCAP log, as ROS 2 messages, one set a frame.

All messages of a frame carry its stamp as log time, so a result lines up with the log it was made from. Nothing that
differs between two equal runs goes in (no times of day, no durations): equal runs give equal bytes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from flow.contracts import FrameRecord, Loss
from recordings.errors import LogError
from recordings.mcap.writer import COMPRESSIONS, Ros2Writer
from recordings.ros2.to_msg import (
    diagnostics,
    disparity_image,
    grid_map,
    occupancy_grid,
    odometry,
    point_cloud,
    reason_map,
    source_image,
    transform_message,
)
from stages.data import Disparity, ElevationMap, NavigationMap, PointCloud, Pose, TiltHealth, Transform

_BUILDERS: dict[type, Callable[[Any], Any]] = {
    Disparity: disparity_image,
    PointCloud: point_cloud,
    ElevationMap: grid_map,
    NavigationMap: occupancy_grid,
    Pose: odometry,
}
# What a message has no room for, and so is told beside it: a guess must not look like a measurement.
_BESIDE: dict[type, tuple[str, Callable[[Any], Any]]] = {
    Disparity: ("source", source_image),
    NavigationMap: ("reason", reason_map),
}
_OK, _WARN, _ERROR = 0, 1, 2  # levels of diagnostic_msgs/DiagnosticStatus
_COUNTS = ("verdict", "interrupted", "pipeline", "frames_in", "frames_out")


@dataclass
class McapSink:
    """Writes streams to /nav/<stream>, the frame's transforms to /tf, its losses to /nav/diagnostics; there too what is
    known of the tilt's health, the stamp from which the cells of a regional map count their times, and at the end the
    findings of the run.

    results: the streams to write: Disparity, PointCloud, ElevationMap, NavigationMap or Pose each; where each pixel of
    a Disparity comes from goes to /nav/<stream>/source, why each cell of a NavigationMap has its state to
    /nav/<stream>/reason. also: further streams, for those who would keep the results as they are. compression: of the
    log, lz4, zstd or none; zstd takes a fifth less room than lz4, and twice the time to write.
    """

    results: tuple[str, ...] = (
        "disparity", "points", "elevation_map", "navigation_map", "pose", "regional_map", "regional_navigation_map",
    )  # fmt: skip

    also: tuple[str, ...] = ()
    compression: str = "lz4"

    suffix = ".mcap"
    names_streams: ClassVar[tuple[str, ...]] = ("results", "also")
    _writer: Ros2Writer = field(init=False, repr=False)
    _last_stamp: int | None = field(default=None, init=False, repr=False)
    empty: bool = field(default=False, init=False, repr=False)  # whether it lacks all results that it is to hold

    def __post_init__(self) -> None:
        if self.compression not in COMPRESSIONS:
            raise ValueError(f"McapSink.compression must be one of {', '.join(COMPRESSIONS)}, not '{self.compression}'")

    def wants(self, stream: str, kind: type) -> bool:
        """Whether a stream of data of type `kind` is to be written. Raises LogError where it is but cannot be."""
        if stream not in self._written:
            return issubclass(kind, TiltHealth)
        if kind not in _BUILDERS:
            known = ", ".join(builder.__name__ for builder in _BUILDERS)
            setting = "results" if stream in self.results else "also"
            raise LogError(
                f"McapSink cannot write '{stream}' of type {kind.__name__} (it writes {known}); leave it out of "
                f"'{setting}'"
            )
        if stream == "diagnostics":
            raise LogError(
                "McapSink cannot write 'diagnostics', for /nav/diagnostics is the ledger's; rename the stream"
            )
        return True

    def open(self, path: Path, streams: Mapping[str, type], about: Mapping[str, str]) -> None:
        """Start the log. about: what it was made from and with, kept as its metadata record "roverflow"."""
        self._last_stamp, self.empty = None, any(stream in streams for stream in self._written)
        self._writer = Ros2Writer(Path(path), keep=True, compression=self.compression)
        try:
            self._writer.metadata("roverflow", about)
        except BaseException:
            self._writer.abort()
            raise

    def write(self, record: FrameRecord) -> None:
        """Write a frame that is through."""
        writer, stamp = self._writer, record.stamp
        for stream in self._written:
            data = record.items.get(stream)
            if data is not None:
                self.empty = False
                writer.write(f"/nav/{stream}", _BUILDERS[type(data)](data), stamp)
            if type(data) in _BESIDE:
                name, build = _BESIDE[type(data)]
                writer.write(f"/nav/{stream}/{name}", build(data), stamp)
        transforms = {(known.parent, known.child): (known, stamp) for known in _transforms(record.items.values())}
        if transforms:
            writer.write("/tf", transform_message(transforms.values()), stamp)
        health = [_health(name, item) for name, item in record.items.items() if isinstance(item, TiltHealth)]
        written = {name: record.items[name] for name in self._written if name in record.items}
        begun = [_begun(name, item) for name, item in written.items() if getattr(item, "epoch", None) is not None]
        statuses = [*_statuses(record.entries), *health, *begun]
        writer.write("/nav/diagnostics", diagnostics(stamp, statuses), stamp)
        self._last_stamp = stamp

    def close(self, summary: Mapping[str, Any]) -> None:
        """Finish the log. summary: of the run: losses after the last frame ("entries"), verdict and counts."""
        writer = self._writer
        if writer.closed:  # a write failed, which was told then
            return
        entries = list(summary.get("entries", ()))
        found = [*summary.get("surveys", {}).items(), *summary.get("findings", {}).items()]
        findings = [_finding(stream, said) for stream, said in found]
        if entries or (findings and self._last_stamp is not None):
            latest = max([0, *(entry.stamp for entry in entries)])
            stamp = latest if self._last_stamp is None else self._last_stamp
            lost = _statuses(entries) if entries else []
            writer.write("/nav/diagnostics", diagnostics(stamp, [*lost, *findings]), stamp)
        counts = {name: str(summary[name]) for name in _COUNTS if name in summary}
        for group in ("drops", "messages"):
            counts |= {f"{group}.{name}": str(count) for name, count in summary.get(group, {}).items()}
        for stream, said in summary.get("findings", {}).items():
            counts[f"findings.{stream}"] = f"{said['severity']}: {said['sentence']}"
        writer.metadata("roverflow.run", counts)
        writer.close()

    def discard(self) -> None:
        """Give up the log; one that stood under its name stays."""
        self._writer.abort()

    @property
    def _written(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys((*self.results, *self.also)))


def _transforms(items: Iterable[Any]) -> Iterator[Transform]:
    """Where the clouds were seen from, and where regional maps have the frame `level`."""
    for item in items:
        known = item.sensor if isinstance(item, PointCloud) else getattr(item, "level", None)
        if known is not None:
            yield known


def _finding(stream: str, said: Mapping[str, str]) -> tuple[int, str, str, dict[str, str]]:
    """The diagnostic status of something that a run found."""
    level = _WARN if said["severity"] == "warning" else _OK
    return level, stream, said["sentence"], {"finding": said["sentence"], "severity": said["severity"]}


def _begun(stream: str, terrain: ElevationMap) -> tuple[int, str, str, dict[str, str]]:
    """The diagnostic status of a map of many frames: from which stamp on its layers "first" and "last" count."""
    text = f"layers first and last count seconds from {terrain.epoch} ns"
    return _OK, stream, text, {"epoch": str(terrain.epoch)}


def _health(stream: str, health: TiltHealth) -> tuple[int, str, str, dict[str, str]]:
    """The diagnostic status of a tilt's health."""
    angles = {"tilt off turn": health.turn, "ground off level": health.ground}
    values = {name: f"{math.degrees(angle):.3f} deg" for name, angle in angles.items() if math.isfinite(angle)}
    values |= {"frames": str(health.frames), "fault": health.fault}
    return _WARN if health.fault else _OK, stream, health.judgement, values


def _statuses(entries: Iterable[Loss]) -> list[tuple[int, str, str, dict[str, str]]]:
    """Diagnostic statuses of losses: one each, or that there is none."""
    statuses = [
        (
            _ERROR, f"{entry.stage}/{entry.stream}", entry.detail,
            {"reason": str(entry.reason), "stream": entry.stream, "stage": entry.stage, "stamp": str(entry.stamp)},
        )
        for entry in entries
    ]  # fmt: skip
    return statuses or [(_OK, "roverflow", "nothing lost", {})]
