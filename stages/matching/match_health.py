"""CheckMatches: the share of the nearest ground that is matched.

The nearest ground has the most texture and the largest disparities. If it is not matched, the search range is too small
or the images are unsuitable, and the matches that remain are noise, which makes pits in a map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flow.contracts import Finding, Severity
from stages.data import Array, Disparity, MatchHealth, PixelOrigin
from stages.stage import Stage

NEAR_ROWS = 0.125  # share of the rows that show the nearest ground
MIN_CONFIDENCE = 0.35  # of a match; those that OpenCV finds of ground closer than the search range have less
MIN_INVERSION = 3.0  # of the disparities at the top over those of the lower half, in images that are upside down
MIN_MATCHED = 0.7  # share of the nearest ground, in the median of the frames
UNMATCHED = (
    "Only {near:.0f} % of the nearest ground is matched, so the map is unreliable there. If that ground is closer than "
    "the search range, increase `disparities`; otherwise check for dark, blurred, frozen or textureless images, for "
    "pairs of different times, or swapped cameras."
)
UPSIDE_DOWN = (
    "The ground at the top of the images is nearer than that in their lower half, so the cameras hang upside down. "
    "Rotate the images by 180 degrees and exchange left and right before they are calibrated and logged."
)


@dataclass(frozen=True)
class CheckMatches(Stage):
    """The matched share of each frame, and a warning at the end of a run if little of the nearest ground is matched.

    The nearest ground is in the lowest eighth of the rows. Its matches of a confidence below 0.35 do not count.
    """

    def start(self) -> list[tuple[float, bool]]:
        """The matched share of the nearest ground of each frame, and if it is small, whether the image is inverted."""
        return []

    def __call__(self, disparity: Disparity, *, state: list[tuple[float, bool]]) -> MatchHealth:
        """The matched share of the right half of the image; the right camera does not see all of the left half."""
        height, width = disparity.pixels.shape
        rows, half = max(1, round(NEAR_ROWS * height)), np.s_[:, width // 2 :]
        source, confidence = disparity.source[half], disparity.confidence[half]
        matched = (source == PixelOrigin.MEASURED) | (source == PixelOrigin.PLANE)
        near = float((matched[-rows:] & ~_doubtful(confidence[-rows:])).mean())
        inverted = near < MIN_MATCHED and _is_inverted(
            np.where(matched & ~_doubtful(confidence), disparity.pixels[half], np.nan), rows
        )
        state.append((near, inverted))
        return MatchHealth(disparity.stamp, float(matched.mean()), near)

    def finding(self, state: list[tuple[float, bool]]) -> Finding | None:
        """A warning if the median share of the frames is below `MIN_MATCHED`."""
        near, inverted = np.median(state, axis=0) if state else (1.0, 0.0)
        if near >= MIN_MATCHED:
            return None
        sentence = UPSIDE_DOWN if inverted > 0.5 else UNMATCHED.format(near=100 * near)
        return Finding(sentence, Severity.WARNING, assumes="cameras")


def _doubtful(confidence: Array) -> Array:
    """Where matches do not count; NaN is the confidence of a stage that states none."""
    return confidence < MIN_CONFIDENCE


def _is_inverted(pixels: Array, rows: int) -> bool:
    """Whether disparities (H, W), NaN = unknown, are larger in the first `rows` than in the lower half."""
    top, low = pixels[:rows], pixels[len(pixels) // 2 :]
    seen = np.isfinite(top).any() and np.isfinite(low).any()
    return bool(seen and np.nanmedian(top) > MIN_INVERSION * np.nanmedian(low))
