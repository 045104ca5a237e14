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
MIN_CONFIDENCE = 0.35  # of a match; those that OpenCV finds of ground closer than the search range have less
MIN_INVERSION = 3.0  # of the disparities at the top over those of the lower half, in images that are upside down
MIN_MATCHED = 0.7  # share of the nearest ground, in the median of the frames


@dataclass(frozen=True)
class CheckMatches(Stage):
    """The matched share of each frame, and a warning at the end of a run if little of the nearest ground is matched.

    The nearest ground is in the lowest eighth of the rows. Its matches of a confidence below 0.35 do not count.
    """

    def start(self) -> list[tuple[float, bool]]:
        """The matched share of the nearest ground, and whether the image is upside down, of each frame; none yet."""
        return []

    def __call__(self, disparity: Disparity, *, state: list[tuple[float, bool]]) -> MatchHealth:
        """The matched share of the right half of the image; the right camera does not see all of the left half."""
        height, width = disparity.pixels.shape
        rows, half = max(1, round(NEAR_ROWS * height)), np.s_[:, width // 2 :]
        source = disparity.source[half]
        matched = (source == PixelOrigin.MEASURED) | (source == PixelOrigin.PLANE)
        confident = matched & ~(disparity.confidence[half] < MIN_CONFIDENCE)  # NaN if a stage states none
        near = float(confident[-rows:].mean())
        pixels = np.where(confident, disparity.pixels[half], np.nan)
        top, low = pixels[:rows], pixels[height // 2 :]
        seen = np.isfinite(top).any() and np.isfinite(low).any()
        state.append((near, bool(seen and np.nanmedian(top) > MIN_INVERSION * np.nanmedian(low))))
        return MatchHealth(disparity.stamp, float(matched.mean()), near)

    def finding(self, state: list[tuple[float, bool]]) -> Finding | None:
        """A warning if the median share of the frames is below `MIN_MATCHED`."""
        near, inverted = np.median(state, axis=0) if state else (1.0, 0.0)
        if near >= MIN_MATCHED:
            return None
        sentence = (
            "The ground at the top of the images is nearer than that in their lower half, so the cameras hang upside "
            "down. Rotate the images by 180 degrees and exchange left and right before they are calibrated and logged."
            if inverted > 0.5
            else f"Only {100 * near:.0f} % of the nearest ground is matched, so the map is unreliable there. If that "
            "ground is closer than the search range, increase `disparities`; otherwise check for dark, blurred, frozen "
            "or textureless images, for pairs of different times, or swapped cameras."
        )
        return Finding(sentence, Severity.WARNING, assumes="cameras")
