"""A rerun recording of every intermediate of a run, laid out by `recordings.sinks.blueprint`.

The loggers draw the items; the recording sets the timelines and writes the ledger and the file. rerun only warns of its
errors by default; here they are raised.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from itertools import pairwise, product
from pathlib import Path
from typing import Any, NamedTuple

import rerun as rr
from rerun.error_utils import catch_and_log_exceptions

from flow.contracts import FrameRecord, Loss, counted
from recordings.atomic_write import give_name, room_to_grow, temporary_name, unwritable, writing
from recordings.errors import LogError
from recordings.follower import Follower
from recordings.sinks.blueprint import (
    APPLICATION,
    FRAMES,
    LAYOUT,
    LEDGER,
    MAX_LEGEND_LINES,
    QUEUES,
    SECONDS,
    SLOWEST,
    SUMMARY,
    Layout,
    Panel,
    ViewSpec,
)  # fmt: skip
from recordings.sinks.canvas import CURVE_RGB, Canvas
from recordings.sinks.entity_rows import BATCH_BYTES
from recordings.sinks.loggers import LOGGERS, same_view
from recordings.sinks.own_loggers import log_own
from recordings.sinks.own_types import plain_type
from stages.data import Array, Disparity, ElevationMap, Pose, StereoFrame

RESERVED_BYTES = 64 << 20  # that must stay free; the largest frame and the file's end need less
MAX_CELL = 60  # characters in a table of the run
PLOT_BATCH, LIVE_BATCH = 32, 4  # frames whose numbers are sent at once, without and with a viewer
BATCH_SECONDS = 3600.0  # batches end by their size, not by the clock
LEVELS = {"warning": rr.TextLogLevel.WARN, "fault": rr.TextLogLevel.ERROR}  # of findings; INFO for others
STEPS = rr.components.InterpolationMode.StepAfter  # how queue depths are drawn
COPIED_BYTES = 1 << 24  # at once
_REMEMBERED = ("_stamp", "_frames", "_work", "_interval", "_rest", "_drawn")
FOOTER_MAGIC = b"RRF2FOOT"  # at the end of a whole recording, before a checksum of 4 bytes


def check_room(partial: Path, path: Path) -> None:
    """Raise UnwritableError before the disk is full: rerun's writer never returns from a full one.

    partial: the file that grows; path: the name it will get.
    """
    if room_to_grow(partial) < RESERVED_BYTES:
        raise unwritable(path, f"less than {RESERVED_BYTES >> 20} MB more can be written there")


class Saved(NamedTuple):
    """A recording at a checkpoint. partials: its temporary name, and those of the recordings that it continues; size:
    bytes of the file; remembered, canvas: attributes of the recording and of its canvas."""

    partials: tuple[str, ...]
    size: int
    remembered: dict[str, Any]
    canvas: dict[str, Any]


class RerunRecording:
    """A recording that is being written.

    settings: the RerunSink; streams: name -> type of item, in the pipeline's order; about: facts of the run for its
    summary.
    """

    def __init__(self, settings: Any, path: Path, streams: Mapping[str, type], about: Mapping[str, str]) -> None:
        self._settings, self._path, self._streams, self._about = settings, Path(path), tuple(streams), dict(about)
        self._partial = temporary_name(self._path)
        self._continued: tuple[str, ...] = ()  # temporary names of recordings that this one continues
        self._viewer: Follower | None = None
        self._stamp = 0  # the latest, ns
        self._frames, self._views = 0, -1
        self._work = Counter[str]()  # stage -> seconds of all frames
        self._loggers: dict[type, list[Callable[..., str | None]]] = {}  # by the type of an item
        with writing(self._path):
            self._partial.open("wb").close()
        try:
            with catch_and_log_exceptions(strict=True):
                self._begin()
        except BaseException:
            self._partial.unlink(missing_ok=True)
            raise
        sized = [name for name, kind in streams.items() if _is(kind, Disparity) or _is(kind, StereoFrame)]
        disparities = [name for name in sized if _is(streams[name], Disparity)]
        self._finals = frozenset(settings.finals).intersection(disparities) or frozenset(disparities[-1:])
        pairs = pairwise(disparities)
        matched = frozenset(one for one, final in pairs if final in self._finals and one not in self._finals)
        self._canvas = Canvas(
            self._recording,
            settings.jpeg_quality,
            settings.max_width,
            sized=frozenset(sized),
            matched=matched,
            counts_bytes=settings.max_megabytes > 0,
            hazard_limits={name: float(value) for name, _, value in (text.partition("=") for text in settings.limits)},
        )
        self._interval, self._rest = settings.every, 1e6 * settings.max_megabytes
        self._drawn = 0  # frames with images

    def _begin(self) -> None:
        check_room(self._partial, self._path)
        batches = rr.ChunkBatcherConfig(flush_tick=BATCH_SECONDS, flush_num_bytes=BATCH_BYTES)
        self._recording = rr.RecordingStream(APPLICATION, batcher_config=batches)
        self._recording.set_log_time_enabled(False)
        self._recording.set_sinks(rr.FileSink(str(self._partial)))
        if self._settings.live_pipe:
            self._viewer = Follower(self._partial, self._settings.live_pipe)
        self._recording.send_recording_name(self._about.get("log", self._path.stem))
        self._recording.log(SUMMARY, _document("RUNNING", self._about), static=True)
        self._recording.flush()  # the file begins with it
        if self._viewer is not None:
            self._viewer.grown()

    def write(self, record: FrameRecord) -> dict[str, str]:
        """Draw one frame; returns why streams of own types have no picture in it."""
        check_room(self._partial, self._path)
        with catch_and_log_exceptions(strict=True):
            canvas, self._stamp = self._canvas, max(record.stamp, self._stamp)
            canvas.at = record.stamp, self._frames
            self._choose_pictures(record.items)
            for stream in record.unchanged:
                canvas.keep_all(stream)
            captions, lost = self._draw(record.items)
            self._plot_work(record)
            canvas.clear_missing()
            canvas.log_text(FRAMES, "; ".join([f"{sum(record.seconds.values()):.2f} s of work", *captions]))
            self._log_losses(record.entries)
            if self._frames or self._viewer is not None:  # a run of one frame sends it at its end only
                self._send_blueprint()
            if (self._frames + 1) % (PLOT_BATCH if self._viewer is None else LIVE_BATCH) == 0:
                canvas.numbers.send()
            if self._viewer is not None:
                canvas.rows.send()
                self._recording.flush()  # a viewer shows each frame at once
                self._viewer.grown()
        self._frames += 1
        return lost

    def checkpoint(self) -> Saved:
        """What the recording contains. All of it is in the file by now."""
        self._canvas.rows.send()
        self._canvas.numbers.send()
        self._recording.flush()
        remembered = {name: getattr(self, name) for name in _REMEMBERED}
        partials = (self._partial.name, *self._continued)
        return Saved(partials, self._partial.stat().st_size, remembered, self._canvas.remembered())

    def resume(self, saved: Saved) -> None:
        """Copy what a recording contained that is unfinished, or has got its name. Raises LogError if it is cut."""
        partial = self._path.with_name(saved.partials[0])
        source = partial if partial.exists() else self._path
        part = temporary_name(self._path)
        try:
            if _copy_start(source, part, saved.size) < saved.size:
                raise LogError(f"{source} lacks a part of the run that is to be resumed; run without --resume")
            with catch_and_log_exceptions(strict=True), warnings.catch_warnings(action="ignore"):  # it has no end
                chunks = rr.chunk.RrdReader(str(part)).stream()
                self._recording.send_chunks(chunk for chunk in chunks if not chunk.entity_path.startswith("/__"))
                self._recording.flush()
        finally:
            part.unlink(missing_ok=True)
        self._continued = saved.partials
        vars(self).update(saved.remembered)
        vars(self._canvas).update(saved.canvas)

    def close(self, summary: Mapping[str, Any]) -> None:
        """End the recording with the run's verdict and give it its name."""
        try:
            with catch_and_log_exceptions(strict=True):
                self._conclude(summary)
            self._publish()
        except (OSError, RuntimeError) as error:  # rerun raises RuntimeError if it cannot write its file
            raise unwritable(self._path, getattr(error, "strerror", None) or str(error)) from error
        finally:
            self._end_viewer()
            self._partial.unlink(missing_ok=True)

    def discard(self) -> None:
        """Discard the recording; an earlier file of its name stays."""
        self._recording.disconnect()
        self._end_viewer()
        self._partial.unlink(missing_ok=True)

    def _end_viewer(self) -> None:
        """Let a viewer have the rest of the file."""
        if self._viewer is not None:
            self._viewer.finish()

    def _conclude(self, summary: Mapping[str, Any]) -> None:
        """Log the verdict, the remaining losses and the findings."""
        verdict, canvas = str(summary.get("verdict", "INCOMPLETE")), self._canvas
        drops = [f"{count} {reason}" for reason, count in dict(summary.get("drops", {})).items()]
        self._log_losses(summary.get("entries", ()))
        canvas.at = self._stamp, canvas.at[1]
        level = rr.TextLogLevel.INFO if verdict == "COMPLETE" else rr.TextLogLevel.WARN
        text = f"{verdict}: {counted(self._frames, 'frame')}{''.join(f', {drop}' for drop in drops)}"
        canvas.log_text(LEDGER, text, level)
        found = [*summary.get("surveys", {}).items(), *summary.get("findings", {}).items()]
        for stream, finding in found:
            level = LEVELS.get(finding["severity"], rr.TextLogLevel.INFO)
            canvas.log_text(LEDGER, f"{stream}: {finding['sentence']}", level)
        canvas.rows.send()
        canvas.numbers.send()
        facts = {key: value for key, value in summary.items() if isinstance(value, str | int | float | Mapping)}
        facts.pop("bottleneck", None)
        for key in {"surveys", "findings"} & facts.keys():
            facts[key] = {name: f"{one['severity']}: {one['sentence']}" for name, one in summary[key].items()}
        pictures = {"frames with images and clouds": f"{self._drawn} of {self._frames}"}
        if self._interval > 1:
            pictures["thinned"] = f"at the end each {self._interval}th frame has images, clouds and surfaces"
        if self._settings.without:
            pictures["not drawn"] = ", ".join(self._settings.without)
        slowest = _slowest(summary.get("bottleneck", {}))
        self._recording.log(SUMMARY, _document(verdict, slowest, self._about, facts, pictures), static=True)
        self._recording.log(LAYOUT, rr.TextDocument(self._layout().as_json()), static=True)
        self._views = -1  # the slowest stages are known now
        self._send_blueprint()

    def _publish(self) -> None:
        """Finish the file, and name it if its end is there: rerun may not report a full disk."""
        self._recording.flush()
        self._recording.disconnect()
        with self._partial.open("rb") as file:
            file.seek(max(0, self._partial.stat().st_size - len(FOOTER_MAGIC) - 4))
            whole = FOOTER_MAGIC in file.read()
        if not whole:
            raise OSError("its end is missing, as after a full disk")
        give_name(self._partial, self._path)
        for name in self._continued:
            self._path.with_name(name).unlink(missing_ok=True)

    def _choose_pictures(self, items: Mapping[str, Any]) -> None:
        """Decide whether this frame's images, clouds and surfaces are drawn, and which streams are no intermediates.

        Counted bytes, and not the file's size, decide, so that a recording does not depend on the speed of writing.
        """
        canvas, room = self._canvas, 1e6 * self._settings.max_megabytes
        while room and room - canvas.logged_bytes < self._rest / 2 and self._rest > 1:
            self._rest, self._interval = self._rest / 2, 2 * self._interval
        canvas.pictures = self._frames % self._interval == 0
        self._drawn += canvas.pictures
        canvas.full_size = self._finals.union(_last_of(StereoFrame, items))

    def _draw(self, items: Mapping[str, Any]) -> tuple[list[str], dict[str, str]]:
        """Log the items of a frame; returns their captions, but for the streams inside a template, and the streams of
        own types without a picture -> why."""
        present = {stream: items[stream] for stream in self._streams if stream in items}
        last = {_shown(stream, item): stream for stream, item in present.items()}
        captions, lost = list[str | None](), dict[str, str]()
        for stream, item in present.items():
            later = last[_shown(stream, item)]
            if later != stream and getattr(item, "layers", {}).keys() <= getattr(present[later], "layers", {}).keys():
                continue
            if (kind := type(item)) not in self._loggers:
                fitting = [log for kinds, log in LOGGERS.items() if len(kinds) == 1 and issubclass(kind, kinds[0])]
                self._loggers[kind] = fitting or [log_own]
            try:
                texts = [log(self._canvas, stream, item) for log in self._loggers[kind]]
            except (ValueError, TypeError, OverflowError) as error:
                if self._loggers[kind] != [log_own]:
                    raise
                texts, lost[stream] = [], str(error)
            captions += texts if "/" not in stream else []
        for kinds, log in LOGGERS.items():
            if len(kinds) > 1:
                for chosen in _together(present, kinds, self._finals):
                    captions.append(log(self._canvas, chosen[0], *(present[stream] for stream in chosen)))
        return [caption for caption in captions if caption], lost

    def _plot_work(self, record: FrameRecord) -> None:
        """Plot the times of the stages and their queues; a frame without a stage has a gap in its line."""
        self._work.update(record.seconds)
        for root, numbers in ((SECONDS, record.seconds), (QUEUES, record.queues)):
            for stage, number in numbers.items():
                view = _stage_view(root, stage)
                if root == QUEUES and (view.panel, view.path) not in self._canvas.views:
                    self._recording.log(view.path, rr.SeriesLines(interpolation_mode=STEPS), static=True)
                self._canvas.log_number(view.path, number, view)

    def _log_losses(self, entries: Iterable[Loss]) -> None:
        """Losses, at their own stamps on the log's clock."""
        for entry in entries:
            text = f"{entry.stage} lost {entry.stream}: {entry.reason}. {entry.detail}"
            self._canvas.log_text(LEDGER, text, rr.TextLogLevel.WARN, (entry.stamp, self._canvas.at[1]))
            self._stamp = max(entry.stamp, self._stamp)

    def _send_blueprint(self) -> None:
        """Send the blueprint again if the frame added a view."""
        if len(self._canvas.views) != self._views:
            self._views = len(self._canvas.views)
            layout = self._layout()
            for stage, color in zip(layout.slowest, CURVE_RGB, strict=False):
                self._recording.log(_stage_view(SECONDS, stage).path, rr.SeriesLines(colors=[color]), static=True)
            self._canvas.name_curves(SLOWEST, layout.slowest)
            self._recording.send_blueprint(layout.blueprint(self._settings.desk))

    def _layout(self) -> Layout:
        slowest = [stage for stage, _ in self._work.most_common(MAX_LEGEND_LINES)]
        return Layout(tuple(self._canvas.views.values()), tuple(slowest))


def _copy_start(source: Path, copy: Path, size: int) -> int:
    """Copy the first bytes of a file, none of a file that does not exist; returns their number."""
    copied = 0
    with writing(copy), suppress(FileNotFoundError), source.open("rb") as file, copy.open("wb") as target:
        while copied < size and (block := file.read(min(COPIED_BYTES, size - copied))):
            copied += target.write(block)
    return copied


@cache
def _stage_view(root: str, stage: str) -> ViewSpec:
    """The time of a stage, or its queue."""
    return ViewSpec(Panel.STAGE, root, rr.escape_entity_path_part(stage), stage)


def _is(kind: Any, wanted: type) -> bool:
    plain = plain_type(kind)
    return isinstance(plain, type) and issubclass(plain, wanted)


def _together(items: Mapping[str, Any], kinds: tuple[type, ...], finals: Collection[str]) -> Iterator[tuple[str, ...]]:
    """The streams for a logger of several types: the last of each type, for every frame of reference.

    A type without a frame of reference goes with every frame. Of stereo frames the last one of the camera's size goes,
    of disparities each of the `finals`.
    """
    items = {stream: item for stream, item in items.items() if isinstance(item, kinds)}
    frames = {getattr(item, "frame_id", None): None for item in items.values()}
    for frame in [frame for frame in frames if frame is not None] or [None]:
        fitting = {stream: item for stream, item in items.items() if getattr(item, "frame_id", frame) == frame}
        last = {kind: _last_of(kind, fitting) for kind in kinds if kind is not Disparity}
        yield from product(*(last.get(kind, [stream for stream in fitting if stream in finals]) for kind in kinds))


def _last_of(kind: type, items: Mapping[str, Any]) -> list[str]:
    """The last stream of this type, if there is one."""
    streams = [stream for stream, item in items.items() if isinstance(item, kind)]
    if kind is StereoFrame:  # of the camera's size
        streams = [stream for stream in streams if same_view(items[stream].camera, items[streams[0]].camera)]
    return streams[-1:]


def _shown(stream: str, item: Any) -> Hashable:
    """What a picture of an item shows. Of streams that show the same the last one is drawn, and layers that it lacks.

    That is stereo with the same pixels, as in a log that is rectified already; an elevation map with the same heights,
    to which later stages add layers; the very same pose.
    """
    arrays: tuple[Array, ...] = ()
    match item:
        case Pose():
            return id(item)
        case StereoFrame():
            arrays = item.left, item.right
        case ElevationMap():
            arrays = (item.layers["elevation"],)
    return tuple((each.ctypes.data, each.shape, each.strides) for each in arrays) or stream


def _slowest(bottleneck: Mapping[str, Any]) -> dict[str, str]:
    """The rows that name the bottleneck."""
    named = {kind: bottleneck[kind] for kind in ("stage", "sink") if kind in bottleneck}
    rows = {
        f"slowest {kind}": f"{one['name']}, {one['seconds_per_frame']:.3f} s a frame" for kind, one in named.items()
    }
    return rows | ({"workers": bottleneck["another_worker"]} if "another_worker" in bottleneck else {})


def _document(verdict: str, *tables: Mapping[str, Any]) -> rr.TextDocument:
    """The verdict and the facts of the run, as markdown."""
    values = {
        key: ", ".join(f"{k} {v}" for k, v in value.items()) if isinstance(value, Mapping) else str(value)
        for table in tables
        for key, value in table.items()
        if value not in ({}, "")
    }
    rows = [f"| {key} | {value} |" for key, value in values.items() if "\n" not in value and len(value) <= MAX_CELL]
    # The viewer wraps paragraphs, but no cells of a table.
    long = [f"**{key}**: {value}\n" for key, value in values.items() if "\n" not in value and len(value) > MAX_CELL]
    texts = [f"## {key}\n```\n{value}\n```" for key, value in values.items() if "\n" in value]
    text = "\n".join([f"# {verdict}", "", "| | |", "|---|---|", *rows, "", *long, *texts])
    return rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
