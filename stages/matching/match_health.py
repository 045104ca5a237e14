"""CheckMatches: is the ground right before the rover matched?

It is the ground with the most texture and the largest disparities. Where it is not matched, the search ends short of
it, or something is wrong with the images; and what is found there all the same is noise, which makes pits in a map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flow.contracts import Finding, Severity, counted
from stages.data import Disparity, MatchHealth, Mount, PixelOrigin, Tilt
from stages.stage import Stage, parameter


@dataclass(frozen=True)
class CheckMatches(Stage):
    """Counts matches, and warns at the end if in most frames the ground before the rover had few; it remembers."""

    near_rows: float = parameter(
        0.125, "share of the rows that show that ground: the lowest, of a camera that hangs the highest",
        low=0.01, high=1.0,
    )  # fmt: skip
    min_matched: float = parameter(0.7, "share of it that must be matched", low=0.0, high=1.0)

    def start(self) -> list[float]:
        """The share that was matched in each frame of one run; none yet."""
        return []

    def __call__(
        self, disparity: Disparity, tilt: Tilt | None = None, mount: Mount | None = None, *, state: list[float]
    ) -> MatchHealth:
        """What is matched, of the right half of the image: part of the left one no other camera sees.

        tilt, mount: tell a camera that hangs; without them it is taken to stand.
        """
        height, width = disparity.pixels.shape
        source = disparity.source[:, width // 2 :]
        matched = (source == PixelOrigin.MEASURED) | (source == PixelOrigin.PLANE)
        rows = max(1, round(self.near_rows * height))
        hangs = tilt is not None and mount is not None and (mount.camera_from_inclinometer @ tilt.up)[1] > 0
        near = float((matched[:rows] if hangs else matched[-rows:]).mean())
        state.append(near)
        return MatchHealth(disparity.stamp, float(matched.mean()), near)

    def finding(self, state: list[float]) -> Finding | None:
        """A warning where that is less than `min_matched` in the median of the frames."""
        if not state or np.median(state) >= self.min_matched:
            return None
        return Finding(
            f"of the nearest ground in view {100 * np.median(state):.0f} % is matched (median of "
            f"{counted(len(state), 'frame')}), what else the map has there may be wrong: set `disparities` larger "
            "if that ground is nearer than the search reaches; or else the images are dark, blurred, bare, or left for "
            "right",
            Severity.WARNING,
        )
