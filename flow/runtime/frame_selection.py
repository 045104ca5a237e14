"""The frame selection: takes every n-th frame of a log, or one frame for each stretch driven.

It decides on each stamp of the pipeline's clock, before other streams are aligned to it. So a frame that is taken has
the same values as in a run of all frames. A frame that is left out is no loss.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from flow.errors import UsageError
from flow.parameters import Checked, parameter

MAX_POSE_AGE = 2_000_000_000  # ns; the place of a frame whose last pose is older is unknown, and the frame is taken


@dataclass(frozen=True)
class Every(Checked):
    """What to take: every `frames`-th frame; or, with `metres`, a frame that far from the last one taken."""

    frames: int = parameter(1, "n, to take every n-th frame", low=1)
    metres: float | None = parameter(None, "distance from the last frame taken to the next", unit="m", low=0)

    def __str__(self) -> str:
        return str(self.frames) if self.metres is None else f"{self.metres:g}m"

    def odometry(self, streams: Mapping[str, type], missing: Mapping[str, str]) -> str | None:
        """The source's stream that measures the stretch, None if none is needed; UsageError where the log lacks it.

        It is the first stream whose items have `distance_to(other)`, m. missing: stream -> why the log lacks it.
        """
        if self.metres is None:
            return None
        name = next((name for name, kind in streams.items() if hasattr(kind, "distance_to")), None)
        why = "the source has none" if name is None else missing.get(name)
        if why is not None:
            raise UsageError(f"--every {self} needs odometry: {why}; or give a number of frames, such as --every 2")
        return name


class FrameSelection:
    """The selection of one run. odometry: the stream of the poses; left_out: number of frames that were not taken."""

    def __init__(self, every: Every, odometry: str | None = None) -> None:
        self.every, self.odometry = every, odometry
        self.seen = self.left_out = 0
        self._newest: Any = None  # the last pose of the log
        self._last: Any = None  # the pose of the last frame taken

    def note(self, pose: Any) -> None:
        """The log's next pose."""
        self._newest = pose

    def takes(self, stamp: int) -> bool:
        """Whether the next frame is taken."""
        self.seen += 1
        if self.every.metres is None:
            taken = (self.seen - 1) % self.every.frames == 0
        else:
            taken = self._driven(stamp, self.every.metres)
        self.left_out += not taken
        return taken

    def _driven(self, stamp: int, metres: float) -> bool:
        """Whether the frame is at least `metres` from the last one taken, or its place is unknown."""
        if self._newest is None or stamp - self._newest.stamp > MAX_POSE_AGE:
            return True
        near = self._last is not None and self._newest.distance_to(self._last) < metres
        if not near:
            self._last = self._newest
        return not near
