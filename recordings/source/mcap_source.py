"""A log as a pipeline's source."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from recordings.errors import LogError
from recordings.source.log import McapLog
from recordings.source.settings import LogSettings
from stages.data import CameraImage, Mount, Pose, Tilt


@dataclass(frozen=True)
class McapSource(LogSettings):
    """The streams of a log: two cameras, tilt, pose, and the mount of the camera on the rover.

    `help(LogSettings)` describes the settings.

    Examples
    --------
    >>> source = McapSource(left="/front/left/image_rect", right="/front/right/image_rect")
    >>> sorted(source.streams)
    ['inclinometer', 'left', 'mount', 'odometry', 'right']
    """

    streams: ClassVar[Mapping[str, type]] = {
        "left": CameraImage,
        "right": CameraImage,
        "inclinometer": Tilt,
        "mount": Mount,
        "odometry": Pose,
    }

    def open(
        self, path: Path | str | Sequence[Path | str], start: float | None = None, end: float | None = None
    ) -> McapLog:
        """Open a log; use the result as a context manager.

        Parameters
        ----------
        path : Path, str or a sequence of them
            An MCAP file, a rosbag2 database, a ROS 1 bag, several of them, or the folder of a recording.
        start, end : float, optional
            The part to read, from `start` to before `end`, seconds after the first message.

        Returns
        -------
        McapLog
            `missing` gives the reason for each stream that the log does not contain.

        Raises
        ------
        LogError
            If the file cannot be read at all, or the range is empty.
        """
        for name, seconds in (("start", start), ("end", end)):
            if seconds is not None and not math.isfinite(seconds):
                raise LogError(f"{name} must be in seconds after the log's first message, not {seconds}")
        return McapLog(path, self, start, end)
