"""CheckMatches: the share of the nearest ground that is matched, and of matches that may be a period off.

The nearest ground has the most texture and the largest disparities. If it is not matched, the search range is too small
or the images are unsuitable, and the matches that remain are noise, which makes pits in a map. Ground that repeats
itself is matched, but perhaps as ground that is nearer or farther.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flow.contracts import Finding, Severity
from stages.data import Array, Disparity, MatchHealth, PixelOrigin, StereoFrame
from stages.matching.repetition import repeated_share
from stages.stage import Stage, check_joined, check_same_time, check_types

NEAR_ROWS = 0.125  # share of the rows that show the nearest ground
MIN_CONFIDENCE = 0.35  # of a match; those that OpenCV finds of ground closer than the search range have less
MIN_MATCHED = 0.7  # share of the nearest ground, in the median of the frames
# Share of the sampled matches with a rival, on average over frames in a row. In test_repetition.py it is less than 0.2
# on simulated ground, and more than 0.7 on stripes.
MIN_REPEATED, FRAMES_IN_A_ROW = 0.25, 5
UNMATCHED = (
    "Only {near:.0f} % of the nearest ground is matched, so the map is unreliable there. If that ground is closer than "
    "the search range, increase `disparities`; otherwise check for dark, blurred, frozen or textureless images, for "
    "pairs of different times, and for cameras that are swapped or hang upside down."
)
REPEATED = (
    "In {count} of {total} frames, first {first:.1f} s after the first one, the ground repeats itself, as regular "
    "stripes along the view do: up to {share:.0f} % of the sampled matches fit as well at another disparity. That "
    "ground may be matched a period off, and the map be metres too low or too high. Compare its heights with known "
    "ones, such as that of the ground at the wheels, or view it from another side: stripes across the view are matched "
    "correctly."
)


@dataclass(frozen=True)
class CheckMatches(Stage):
    """The matched share of each frame, and a warning at the end of a run if matches are too few or ambiguous.

    They are too few where little of the nearest ground is matched. It is in the lowest eighth of the rows; its matches
    of a confidence below 0.35 do not count. They are ambiguous where the ground repeats itself, so that it may be
    matched a period off. This is tested only with a `frame`, the rectified one.
    """

    def start(self) -> list[MatchHealth]:
        """The results of the frames so far."""
        return []

    def __call__(
        self, disparity: Disparity, frame: StereoFrame | None = None, *, state: list[MatchHealth]
    ) -> MatchHealth:
        """The matched shares. The near ground is that of the right half, which the right camera sees entirely."""
        check_types(self, disparity=disparity)
        height, width = disparity.pixels.shape
        ground = np.s_[-max(1, round(NEAR_ROWS * height)) :, width // 2 :]
        matched = (disparity.source == PixelOrigin.MEASURED) | (disparity.source == PixelOrigin.PLANE)
        doubtful = disparity.confidence[ground] < MIN_CONFIDENCE  # NaN is the confidence of a stage that states none
        repeated = math.nan
        if frame is not None:
            check_joined(self, frame, disparity)
            check_same_time(self, frame=frame.stamp, disparity=disparity.stamp)
            repeated = repeated_share(frame, disparity)
        health = MatchHealth(disparity.stamp, _share(matched), _share(matched[ground] & ~doubtful), repeated)
        state.append(health)
        return health

    def finding(self, state: list[MatchHealth]) -> Finding | None:
        """A warning if the median share of the frames is below `MIN_MATCHED`, or if the ground repeats itself."""
        near = float(np.median([health.near for health in state])) if state else 1.0
        found = [UNMATCHED.format(near=100 * near)] if near < MIN_MATCHED else []
        found += _repetition(state)
        return Finding(" ".join(found), Severity.WARNING, assumes="cameras") if found else None


def _repetition(run: Sequence[MatchHealth]) -> list[str]:
    """A sentence if the ground of some frames in a row repeats itself."""
    tested = [health for health in run if math.isfinite(health.repeated)]
    shares = np.array([health.repeated for health in tested])
    window = min(FRAMES_IN_A_ROW, len(shares))
    if not window or np.convolve(shares, np.full(window, 1 / window), "valid").max() < MIN_REPEATED:
        return []
    times = [(health.stamp - run[0].stamp) / 1e9 for health in tested if health.repeated >= MIN_REPEATED]
    return [REPEATED.format(count=len(times), total=len(run), first=times[0], share=100 * shares.max())]


def _share(chosen: Array) -> float:
    return float(np.count_nonzero(chosen) / chosen.size)
