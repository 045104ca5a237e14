"""A rerun recording of the differences of two results: A, B, and B less A beside each other on one timeline."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from flow.contracts import as_text
from recordings.atomic_write import written
from recordings.comparison.diff import MessageDifference
from recordings.comparison.pages import PAGES, pages
from recordings.comparison.sweep import Sweep
from recordings.png import png
from recordings.ros2.cdr import full_name
from recordings.sinks.blueprint import CLOCK, FRAME
from recordings.sinks.rerun_recording import check_room

MAX_FRAMES = 50  # stamps that are drawn
MAX_WAITING = 4  # messages that wait for a thread that draws them
_SIDES = {"a": "A", "b": "{}", "difference": "{} less A"}  # entity -> name of its view, of a variant


class DiffRecording:
    """Collects the pages of differences and writes them as a recording.

    Examples
    --------
    >>> recording = DiffRecording()
    >>> diff(Path("a.mcap"), Path("b.mcap"), recording.of())  # doctest: +SKIP
    >>> recording.write(Path("diff.rrd"), "a and b")  # doctest: +SKIP
    """

    def __init__(self) -> None:
        self.stamps: list[int] = []
        self.left_out = set[int]()  # stamps
        self.errors: Sequence[tuple[str, int, bytes]] = ()  # variant, stamp and page of errors against the truth
        self._names = dict[str, str]()
        self._drawing: list[tuple[str, int, Future[tuple[bytes, ...]]]] = []
        self._threads = ThreadPoolExecutor(2, thread_name_prefix="pages")

    @property
    def pictures(self) -> list[tuple[str, int, tuple[bytes, ...]]]:
        """Topic, stamp, and the pages of A, B and their difference."""
        drawn = ((topic, stamp, pages.result()) for topic, stamp, pages in self._drawing)
        return [each for each in drawn if each[2]]

    def of(self, variant: str = "", name: str = "B") -> Callable[[MessageDifference], None]:
        """A function that draws differences, unless enough stamps are drawn. variant: letter of B; name: its tab."""
        prefix = f"/{variant}" if variant else ""
        self._names[prefix] = name
        return partial(self._add, prefix)

    def _add(self, prefix: str, change: MessageDifference) -> None:
        if change.one is None or change.other is None or full_name(change.one.__msgtype__) not in PAGES:
            return
        if change.stamp not in self.stamps:
            if len(self.stamps) == MAX_FRAMES:
                self.left_out.add(change.stamp)
                return
            self.stamps.append(change.stamp)
        self._drawing.append((prefix + change.topic, change.stamp, self._threads.submit(_drawn, change)))
        if len(self._drawing) > MAX_WAITING:
            self._drawing[-MAX_WAITING - 1][2].result()

    def write(self, path: Path, name: str, tables: str = "", sweep: Sweep | None = None) -> None:
        """Write the recording. tables: Markdown that is shown beside the pictures. Raises UnwritableError."""
        pictures = self.pictures
        with written(path) as temporary:
            check_room(temporary, path)
            stream = rr.RecordingStream("roverflow_diff")
            stream.set_log_time_enabled(False)
            stream.set_sinks(rr.FileSink(str(temporary)))
            stream.send_recording_name(as_text(name))
            stream.log("tables", rr.TextDocument(as_text(tables), media_type=rr.MediaType.MARKDOWN), static=True)
            if sweep is not None:
                sweep.log(stream)
            for topic, stamp, sides in pictures:
                stream.set_time(CLOCK, timestamp=np.datetime64(stamp, "ns"))
                stream.set_time(FRAME, sequence=self.stamps.index(stamp))
                check_room(temporary, path)
                for side, picture in zip(_SIDES, sides, strict=True):
                    stream.log(f"{topic}/{side}", rr.EncodedImage(contents=picture, media_type="image/png"))
            for variant, stamp, picture in self.errors:
                stream.set_time(CLOCK, timestamp=np.datetime64(stamp, "ns"))
                stream.log(f"errors/{variant}", rr.EncodedImage(contents=picture, media_type="image/png"))
            stream.send_blueprint(self._blueprint([] if sweep is None else [sweep.views()]))
            stream.flush()
            stream.disconnect()

    def _blueprint(self, plots: list[rrb.Container]) -> rrb.Blueprint:
        paths = dict[str, dict[str, None]]()
        for path, _, _ in self.pictures:
            paths.setdefault(path[: path.index("/nav/")], {})[path] = None
        variants = {variant: [_beside(path, variant[1:] or "B") for path in own] for variant, own in paths.items()}
        tabs: list[rrb.Container] = [
            *plots,
            *(rrb.Tabs(*topics, name=self._names[variant]) for variant, topics in variants.items()),
        ]
        if len(variants) == 1:
            tabs[len(plots) :] = next(iter(variants.values()))
        if wrong := dict.fromkeys(variant for variant, _, _ in self.errors):
            views = [rrb.Spatial2DView(origin=f"errors/{variant}", name=f"{variant} less truth") for variant in wrong]
            tabs.append(rrb.Grid(*views, grid_columns=min(3, len(views)), name="errors of disparity"))
        table = rrb.TextDocumentView(origin="tables", name="what differs")
        return rrb.Blueprint(
            rrb.Vertical(rrb.Tabs(*tabs), table, row_shares=[3, 1]) if tabs else table,
            rrb.TimePanel(state="collapsed", timeline=CLOCK),
            collapse_panels=True,
        )


def _beside(path: str, variant: str) -> rrb.Container:
    """The pages of a topic beside each other."""
    views = (rrb.Spatial2DView(origin=f"{path}/{side}", name=name.format(variant)) for side, name in _SIDES.items())
    return rrb.Horizontal(*views, name=path[path.index("/nav") :])


def _drawn(change: MessageDifference) -> tuple[bytes, ...]:
    """The pages of a difference as PNG files; none for two sizes, or a map without elevations."""
    found = pages(full_name(change.one.__msgtype__), change.one, change.other)
    return () if found is None else tuple(png(page.pixels) for page in found)
