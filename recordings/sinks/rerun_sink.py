"""Writes every intermediate of a run into a rerun recording, for the debugging desk of `recordings.sinks.blueprint`.

The pictures are in `recordings.sinks.loggers`; this is their clock, their ledger and their file. rerun's errors, by
its default mere warnings, are raised.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from resource import RLIM_INFINITY, RLIMIT_FSIZE, getrlimit
from shutil import disk_usage
from typing import Any

import numpy as np
import rerun as rr
from rerun.error_utils import catch_and_log_exceptions

from flow.contracts import FrameRecord, Loss, counted
from recordings.atomic_write import give_name, temporary_name, unwritable, writing
from recordings.errors import LogError
from recordings.sinks.blueprint import CLOCK, FRAME, LEDGER, QUEUES, SECONDS, SUMMARY, Panel, ViewSpec, blueprint
from recordings.sinks.loggers import PICTURES, Canvas, same_view
from stages.data import Array, ElevationMap, Pose, StereoFrame

RESERVE = 64 << 20  # bytes that must stay free; the largest frame and the file's end fit in well
PLOTTED = 32  # frames whose times and queues are sent at once
STEPS = rr.components.InterpolationMode.StepAfter  # how numbers of frames are drawn
END = b"RRF2FOOT"  # the last magic number of a whole recording, before a checksum of 4 bytes


@dataclass(eq=False)
class RerunSink:
    """Writes a rerun recording, which `rerun FILE.rrd` opens.

    application_id: recordings of one application share the viewer's saved layout.
    max_points: of a cloud at most so many points are kept, every n-th of them; the cloud in the result log is whole.
    jpeg_quality: of the camera images, 1 to 100.
    """

    application_id: str = "roverflow"
    max_points: int = 50_000
    jpeg_quality: int = 80

    suffix = ".rrd"

    def __post_init__(self) -> None:
        if self.max_points < 1:
            raise ValueError(f"RerunSink.max_points must be at least 1, not {self.max_points}")
        if not 1 <= self.jpeg_quality <= 100:
            raise ValueError(f"RerunSink.jpeg_quality must be 1 to 100, not {self.jpeg_quality}")
        self._closed = True

    def wants(self, stream: str, kind: type) -> bool:
        """Whether there is a picture of items of type `kind`."""
        return any(issubclass(kind, wanted) for kinds in PICTURES for wanted in kinds)

    def open(self, path: Path, streams: Mapping[str, type], about: Mapping[str, str]) -> None:
        """Begin a recording. streams: name -> type of item, in the pipeline's order; about: what to say of the run."""
        self._path, self._streams, self._about = Path(path), tuple(streams), dict(about)
        self._partial = temporary_name(self._path)
        self._stamp = 0  # the latest, ns
        self._frames, self._hung = 0, -1
        self._plots: list[tuple[int, int, dict[str, float]]] = []  # of frames: stamp, number, value of each path
        with writing(self._path):
            self._partial.open("wb").close()
        try:
            with catch_and_log_exceptions(strict=True):
                self._begin()
        except BaseException:
            self._partial.unlink(missing_ok=True)
            raise
        self._canvas = Canvas(self._recording, self.jpeg_quality, self.max_points)
        self._closed = False

    def _check_room(self) -> None:
        """Raise LogError before the disk is full: rerun's writer does not return from a full one."""
        if _room(self._partial) < RESERVE:
            raise unwritable(self._path, f"less than {RESERVE >> 20} MB more can be written there")

    def _begin(self) -> None:
        self._check_room()
        self._recording = rr.RecordingStream(self.application_id)
        self._recording.set_log_time_enabled(False)
        self._recording.set_sinks(rr.FileSink(str(self._partial)))
        self._recording.send_recording_name(self._about.get("log", self._path.stem))
        self._recording.log(SUMMARY, _document("RUNNING", self._about), static=True)
        self._recording.flush()  # so that the file begins with it

    def write(self, record: FrameRecord) -> None:
        """Draw one frame. May be called from any thread, one call at a time."""
        if self._closed:
            raise LogError("RerunSink is not open")
        self._check_room()
        with catch_and_log_exceptions(strict=True):
            self._set_clocks(record.stamp, self._frames)
            captions = self._draw(record.items)
            self._plot(record)
            self._canvas.clear_the_rest()
            text = "; ".join([f"{sum(record.seconds.values()):.2f} s of work", *captions])
            self._recording.log(LEDGER, rr.TextLog(text, level=rr.TextLogLevel.INFO))
            self._enter(record.entries, self._frames)
            self._arrange()
        self._frames += 1

    def close(self, summary: Mapping[str, Any]) -> None:
        """End the recording with the run's verdict and give it its name. Does nothing where none is open."""
        if self._closed:
            return
        self._closed = True
        try:
            with catch_and_log_exceptions(strict=True):
                self._conclude(summary)
            self._publish()
        except (OSError, RuntimeError) as error:  # rerun says RuntimeError where its file could not be written
            raise unwritable(self._path, getattr(error, "strerror", None) or str(error)) from error
        finally:
            self._partial.unlink(missing_ok=True)

    def discard(self) -> None:
        """Give up the recording; one that stood under its name stays. Does nothing where none is open."""
        if not self._closed:
            self._closed = True
            self._recording.disconnect()
            self._partial.unlink(missing_ok=True)

    def _conclude(self, summary: Mapping[str, Any]) -> None:
        """Enter what there is to say of the whole run."""
        self._send_plots()
        verdict = str(summary.get("verdict", "INCOMPLETE"))
        last = max(0, self._frames - 1)
        drops = [f"{count} {reason}" for reason, count in dict(summary.get("drops", {})).items()]
        self._enter(summary.get("entries", ()), last)
        self._set_clocks(self._stamp, last)
        level = rr.TextLogLevel.INFO if verdict == "COMPLETE" else rr.TextLogLevel.WARN
        text = f"{verdict}: {counted(self._frames, 'frame')}{''.join(f', {drop}' for drop in drops)}"
        self._recording.log(LEDGER, rr.TextLog(text, level=level))
        said = [*summary.get("surveys", {}).items(), *summary.get("findings", {}).items()]
        for stream, found in said:
            level = rr.TextLogLevel.WARN if found["severity"] == "warning" else rr.TextLogLevel.INFO
            self._recording.log(LEDGER, rr.TextLog(f"{stream}: {found['sentence']}", level=level))
        facts = {key: value for key, value in summary.items() if isinstance(value, str | int | float | Mapping)}
        for key in {"surveys", "findings"} & facts.keys():
            facts[key] = {name: f"{found['severity']}: {found['sentence']}" for name, found in summary[key].items()}
        self._recording.log(SUMMARY, _document(verdict, self._about, facts), static=True)
        self._arrange()

    def _publish(self) -> None:
        """Finish the file, and name it if its end is there: of a disk that is full rerun tells late, or nobody."""
        self._recording.flush()
        self._recording.disconnect()
        with self._partial.open("rb") as file:
            file.seek(max(0, self._partial.stat().st_size - len(END) - 4))
            whole = END in file.read()
        if not whole:
            raise OSError("its end is missing, as after a full disk")
        give_name(self._partial, self._path)

    def _set_clocks(self, stamp: int, frame: int) -> None:
        """rerun's clocks belong to the calling thread, so every call from outside sets them first."""
        self._stamp = max(stamp, self._stamp)
        self._recording.set_time(CLOCK, timestamp=np.datetime64(stamp, "ns"))
        self._recording.set_time(FRAME, sequence=frame)

    def _draw(self, items: Mapping[str, Any]) -> list[str]:
        """Draw every picture these items allow; what the pictures say of them."""
        present = {stream: items[stream] for stream in self._streams if stream in items}
        captions = []
        for stream, item in present.items():
            if _drawn_later(stream, present):
                continue
            for kinds, draw in PICTURES.items():
                if len(kinds) == 1 and isinstance(item, kinds[0]):
                    captions.append(draw(self._canvas, stream, item))
        for kinds, draw in PICTURES.items():
            if len(kinds) > 1:
                for chosen in _together(present, kinds):
                    captions.append(draw(self._canvas, chosen[0], *(present[stream] for stream in chosen)))
        return [caption for caption in captions if caption]

    def _plot(self, record: FrameRecord) -> None:
        """Stage times and queues: kept, and sent for many frames at once, for they would be half of all calls."""
        values = {}
        for root, numbers in ((SECONDS, record.seconds), (QUEUES, record.queues)):
            for stage, number in numbers.items():
                path = f"{root}/{rr.escape_entity_path_part(stage)}"
                values[path] = float(number)
                if root == QUEUES and (Panel.STAGE, path) not in self._canvas.hung:
                    self._recording.log(path, rr.SeriesLines(interpolation_mode=STEPS), static=True)
                self._canvas.add_view(ViewSpec(Panel.STAGE, path, stage))
        self._plots.append((record.stamp, self._frames, values))
        if len(self._plots) == PLOTTED:
            self._send_plots()

    def _send_plots(self) -> None:
        """Send what is kept; a frame without a stage has a gap in its line."""
        if not self._plots:
            return
        stamps, frames, kept = zip(*self._plots, strict=True)
        self._plots, clocks = [], _clocks(stamps, frames)
        for path in [place.path for place in self._canvas.hung.values() if place.panel is Panel.STAGE]:
            columns = rr.Scalars.columns(scalars=[values.get(path, math.nan) for values in kept])
            self._recording.send_columns(path, indexes=clocks, columns=columns, strict=True)

    def _enter(self, entries: Iterable[Loss], frame: int) -> None:
        """Losses, at their own stamps on the log's clock."""
        losses = sorted(entries, key=lambda entry: entry.stamp)
        if not losses:
            return
        texts = [f"{entry.stage} lost {entry.stream}: {entry.reason}. {entry.detail}" for entry in losses]
        clocks = _clocks([entry.stamp for entry in losses], [frame] * len(losses))
        columns = rr.TextLog.columns(text=texts, level=[rr.TextLogLevel.WARN] * len(losses))
        self._recording.send_columns(LEDGER, indexes=clocks, columns=columns, strict=True)
        self._stamp = max(losses[-1].stamp, self._stamp)

    def _arrange(self) -> None:
        """Lay out the desk again when a picture has come to it."""
        if len(self._canvas.hung) != self._hung:
            self._hung = len(self._canvas.hung)
            self._recording.send_blueprint(blueprint(self._canvas.hung.values()))


def _clocks(stamps: Sequence[int], frames: Sequence[int]) -> list[rr.TimeColumn]:
    """The recording's two clocks at these stamps, ns, and frames."""
    times = np.array(stamps, "datetime64[ns]")
    return [rr.TimeColumn(CLOCK, timestamp=times), rr.TimeColumn(FRAME, sequence=frames)]


def _together(items: Mapping[str, Any], kinds: tuple[type, ...]) -> Iterator[list[str]]:
    """The streams that a picture of several types is drawn from: the last of each type, for every frame of reference.

    A type that names no frame goes with every one. Of stereo frames it is the last as the camera took it.
    """
    frames = {getattr(item, "frame_id", None): None for item in items.values() if isinstance(item, kinds)}
    for frame in [frame for frame in frames if frame is not None] or [None]:
        fitting = {stream: item for stream, item in items.items() if getattr(item, "frame_id", frame) == frame}
        chosen = [_one_of(kind, fitting) for kind in kinds]
        if all(chosen):
            yield [stream for streams in chosen for stream in streams]


def _one_of(kind: type, items: Mapping[str, Any]) -> list[str]:
    """The stream of this type to draw, if there is one."""
    streams = [stream for stream, item in items.items() if isinstance(item, kind)]
    if kind is StereoFrame:  # as the camera took it: not at half size, say
        streams = [stream for stream in streams if same_view(items[stream].camera, items[streams[0]].camera)]
    return streams[-1:]


def _drawn_later(stream: str, items: Mapping[str, Any]) -> bool:
    """Whether a later stream shows the same: stereo with the very same pixels, as where the log was rectified already,
    an elevation map of the same heights with layers added, or the very same pose, as where the log has one."""
    mine, later = items[stream], islice(items.values(), list(items).index(stream) + 1, None)
    if isinstance(mine, Pose):
        return any(item is mine for item in later)
    if isinstance(mine, StereoFrame):
        frames = (item for item in later if isinstance(item, StereoFrame))
        return any(_same(item.left, mine.left) and _same(item.right, mine.right) for item in frames)
    if isinstance(mine, ElevationMap):
        maps = (item.layers for item in later if isinstance(item, ElevationMap))
        return any(mine.layers.keys() <= layers.keys() and _same(layers["elevation"], mine.layers["elevation"])
                   for layers in maps)  # fmt: skip
    return False


def _same(one: Array, other: Array) -> bool:
    return bool(one.__array_interface__ == other.__array_interface__)


def _document(verdict: str, *tables: Mapping[str, Any]) -> rr.TextDocument:
    """The verdict and tables of what is known of the run, as markdown."""
    rows = [
        f"| {key} | {', '.join(f'{k} {v}' for k, v in value.items()) if isinstance(value, Mapping) else value} |"
        for table in tables
        for key, value in table.items()
        if value not in ({}, "")
    ]
    text = "\n".join([f"# {verdict}", "", "| | |", "|---|---|", *rows])
    return rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)


def _room(file: Path) -> int:
    """By how many bytes a file may still grow: what the disk has, and what a process is allowed to write into one."""
    free, (allowed, _) = disk_usage(file.parent).free, getrlimit(RLIMIT_FSIZE)
    if allowed == RLIM_INFINITY:
        return free
    return min(free, allowed - (file.stat().st_size if file.exists() else 0))
