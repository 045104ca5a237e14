"""The sink that writes every intermediate of a run into a rerun recording, and what it can draw.

rerun takes long to import, so it is imported when a recording is opened.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, is_dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from flow.contracts import FrameRecord
from flow.parameters import Checked, parameter, set_by_run
from recordings.errors import LogError
from recordings.sinks import DESKS, ENTITIES
from recordings.sinks.overwrite import refuse_foreign
from recordings.sinks.own_types import NUMBERS, plain_type
from stages.data import Mount, Region

if TYPE_CHECKING:
    from recordings.sinks.rerun_recording import RerunRecording, Saved


@dataclass(eq=False)
class RerunSink(Checked):
    """Writes a rerun recording, which `rerun FILE.rrd` opens.

    A type of `stages.data` is drawn by its logger. Of other types, images, numbers, texts, points, and tables and
    dataclasses of these are drawn.

    Examples
    --------
    >>> from recordings import RerunSink
    >>> RerunSink(jpeg_quality=95).wants("sharpness", float)
    True
    """

    max_width: int = parameter(
        0, "largest width of pictures; intermediates have three eighths of it. 0: half the width of the images, but "
        "320 to 640 px, and for intermediates 120 to 240 px",
        low=0, unit="px",
    )  # fmt: skip
    jpeg_quality: int = parameter(75, "JPEG quality of the camera images", low=1, high=100)
    every: int = parameter(1, "draw images, clouds and surfaces of every n-th frame", low=1)
    max_megabytes: int = parameter(
        0, "size limit of the recording before compression; 0: no limit. Images, clouds and surfaces are drawn half as "
        "often each time that half of the remaining space is used",
        low=0, unit="MB",
    )  # fmt: skip
    without: tuple[str, ...] = parameter((), "streams not to draw: names, or patterns such as disparity/*")
    desk: str = parameter("overview", "layout that the viewer opens with", choices=DESKS)

    live_pipe: int = set_by_run(0)  # file descriptor to a viewer, which gets the recording as it is written; 0: none
    finals: tuple[str, ...] = set_by_run(())  # disparities that no other one is made from; none: the last is
    limits: tuple[str, ...] = set_by_run(())  # of layers, as elevation_map/step=0.17, which their scales show

    suffix = ".rrd"
    names_patterns: ClassVar[tuple[str, ...]] = ("without",)
    asks: ClassVar = {"keep_costs": True}  # of matchers

    def __post_init__(self) -> None:
        super().__post_init__()
        self._recording: RerunRecording | None = None  # while it is open

    def wants(self, stream: str, kind: Any) -> bool:
        """Whether items of type `kind` can be drawn."""
        from recordings.sinks.loggers import LOGGERS

        if any(fnmatchcase(stream, pattern) for pattern in self.without):
            return False
        plain = plain_type(kind)
        if not isinstance(plain, type) or issubclass(plain, Mount | Region):
            return False
        known = (wanted for kinds in LOGGERS for wanted in kinds)
        return issubclass(plain, (*known, str, *NUMBERS, np.ndarray, Mapping)) or is_dataclass(plain)

    def unwritable(self, stream: str, kind: Any) -> str:
        """Why the sink cannot draw a stream that it is to draw, in a sentence; empty where it can."""
        entity = stream.partition("/")[0]
        if entity not in ENTITIES or not self.wants(stream, kind):
            return ""
        return f"RerunSink cannot draw '{stream}': the recording has an entity /{entity} of its own; rename the stream"

    def open(self, path: Path, streams: Mapping[str, type], about: Mapping[str, str]) -> None:
        """Begin a recording.

        streams: name -> type of item, in the pipeline's order; about: facts of the run for its summary.
        """
        from recordings.sinks.rerun_recording import RerunRecording

        refuse_foreign(path, "recording")
        self._recording = RerunRecording(self, path, streams, about)

    def write(self, record: FrameRecord) -> dict[str, str]:
        """Draw one frame; returns why streams have no picture in it. May be called from any thread, one call at a
        time."""
        if self._recording is None:
            raise LogError("RerunSink is not open")
        return self._recording.write(record)

    def checkpoint(self) -> Saved:
        """What the recording contains by now."""
        if self._recording is None:
            raise LogError("RerunSink is not open")
        return self._recording.checkpoint()

    def resume(self, saved: Saved) -> None:
        """Continue the recording of a checkpoint, after `open`. Raises LogError if it is not all there."""
        if self._recording is None:
            raise LogError("RerunSink is not open")
        self._recording.resume(saved)

    def close(self, summary: Mapping[str, Any]) -> None:
        """End the recording with the run's verdict and give it its name. Does nothing if none is open."""
        recording, self._recording = self._recording, None
        if recording is not None:
            recording.close(summary)

    def discard(self) -> None:
        """Discard the recording; an earlier file of its name stays. Does nothing if none is open."""
        recording, self._recording = self._recording, None
        if recording is not None:
            recording.discard()
