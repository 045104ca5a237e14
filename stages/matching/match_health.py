"""CheckMatches: the share of the nearest ground that is matched.

The nearest ground has the most texture and the largest disparities. If it is not matched, the search range is too small
or the images are unsuitable, and the matches that remain are noise, which makes pits in a map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flow.contracts import Finding, Severity
from stages.data import Disparity, MatchHealth, PixelOrigin
from stages.stage import Stage

NEAR_ROWS = 0.125  # share of the rows that show the nearest ground
MIN_MATCHED = 0.7  # share of the nearest ground, in the median of the frames


@dataclass(frozen=True)
class CheckMatches(Stage):
    """The matched share of each frame, and a warning at the end of a run if little of the nearest ground is matched.

    The nearest ground is in the lowest eighth of the rows.
    """

    def start(self) -> list[float]:
        """The matched shares of the nearest ground, one for each frame of a run; none yet."""
        return []

    def __call__(self, disparity: Disparity, *, state: list[float]) -> MatchHealth:
        """The matched share of the right half of the image; the right camera does not see all of the left half."""
        height, width = disparity.pixels.shape
        source = disparity.source[:, width // 2 :]
        matched = (source == PixelOrigin.MEASURED) | (source == PixelOrigin.PLANE)
        near = float(matched[-max(1, round(NEAR_ROWS * height)) :].mean())
        state.append(near)
        return MatchHealth(disparity.stamp, float(matched.mean()), near)

    def finding(self, state: list[float]) -> Finding | None:
        """A warning if the median of the frames is below `MIN_MATCHED`."""
        if not state or np.median(state) >= MIN_MATCHED:
            return None
        return Finding(
            f"Only {100 * np.median(state):.0f} % of the nearest ground is matched, so the map is unreliable there. If "
            "that ground is closer than the search range, increase `disparities`; otherwise check for dark, blurred, "
            "frozen or textureless images, for pairs of different times, or swapped cameras.",
            Severity.WARNING,
            assumes="cameras",
        )
