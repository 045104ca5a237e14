"""CheckMatches: the share of the nearest ground that is matched.

The nearest ground has the most texture and the largest disparities. If it is not matched, the search range is too small
or the images are unsuitable, and the matches that remain are noise, which makes pits in a map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flow.contracts import Finding, Severity
from stages.data import Array, Disparity, MatchHealth, PixelOrigin
from stages.stage import Stage, check_types

NEAR_ROWS = 0.125  # share of the rows that show the nearest ground
MIN_CONFIDENCE = 0.35  # of a match; those that OpenCV finds of ground closer than the search range have less
MIN_MATCHED = 0.7  # share of the nearest ground, in the median of the frames
UNMATCHED = (
    "Only {near:.0f} % of the nearest ground is matched, so the map is unreliable there. If that ground is closer than "
    "the search range, increase `disparities`; otherwise check for dark, blurred, frozen or textureless images, for "
    "pairs of different times, and for cameras that are swapped or hang upside down."
)


@dataclass(frozen=True)
class CheckMatches(Stage):
    """The matched share of each frame, and a warning at the end of a run if little of the nearest ground is matched.

    The nearest ground is in the lowest eighth of the rows. Its matches of a confidence below 0.35 do not count.
    """

    def start(self) -> list[float]:
        """The matched share of the nearest ground of each frame."""
        return []

    def __call__(self, disparity: Disparity, *, state: list[float]) -> MatchHealth:
        """The matched shares. The near ground is that of the right half, which the right camera sees entirely."""
        check_types(self, disparity=disparity)
        height, width = disparity.pixels.shape
        ground = np.s_[-max(1, round(NEAR_ROWS * height)) :, width // 2 :]
        matched = (disparity.source == PixelOrigin.MEASURED) | (disparity.source == PixelOrigin.PLANE)
        doubtful = disparity.confidence[ground] < MIN_CONFIDENCE  # NaN is the confidence of a stage that states none
        near = _share(matched[ground] & ~doubtful)
        state.append(near)
        return MatchHealth(disparity.stamp, _share(matched), near)

    def finding(self, state: list[float]) -> Finding | None:
        """A warning if the median share of the frames is below `MIN_MATCHED`."""
        near = float(np.median(state)) if state else 1.0
        if near >= MIN_MATCHED:
            return None
        return Finding(UNMATCHED.format(near=100 * near), Severity.WARNING, assumes="cameras")


def _share(chosen: Array) -> float:
    return float(np.count_nonzero(chosen) / chosen.size)
