"""An MCAP log as a pipeline's source.

`open` gives the log (`mcap_log`), whose opening (`mcap_opening`) says for each stream that it cannot give why not.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from recordings.errors import LogError
from recordings.source.log import McapLog
from recordings.source.settings import LogSettings
from stages.data import CameraImage, Mount, Pose, Tilt


@dataclass(frozen=True)
class McapSource(LogSettings):
    """A log's two cameras, its tilt and pose, and how they sit on the rover; the settings say where they are."""

    streams: ClassVar[Mapping[str, type]] = {
        "left": CameraImage,
        "right": CameraImage,
        "inclinometer": Tilt,
        "mount": Mount,
        "odometry": Pose,
    }

    def open(self, path: Path, start: float | None = None, end: float | None = None) -> McapLog:
        """The log at `path`, from `start` to before `end` (seconds after its first message).

        Raises LogError where it cannot be read at all; what it lacks is told by its `missing`.
        """
        for name, seconds in (("start", start), ("end", end)):
            if seconds is not None and not math.isfinite(seconds):
                raise LogError(f"{name} must be a number of seconds after the log's first message, not {seconds}")
        return McapLog(Path(path), self, start, end)
