"""Per-pixel validity of a disparity image: where a disparity comes from, or why a pixel has none."""

from __future__ import annotations

from enum import IntEnum
from typing import Any


class PixelOrigin(IntEnum):
    """Where a disparity comes from, or why a pixel has none: the codes of `Disparity.source`."""

    UNKNOWN = 0  # no disparity; the reason is not recorded
    MEASURED = 1  # matched at this pixel
    PLANE = 2  # taken from a plane through neighbouring matches, which replaces a missing or inconsistent match
    FILLED = 3  # guessed from neighbouring disparities
    OUT_OF_VIEW = 4  # the partner lies at or beyond the border of the right image
    OUT_OF_RANGE = 5  # the match is at or beyond an end of the search range, beyond max_depth, or far off the prior
    LEFT_RIGHT = 6  # the right image's pixel matches a different pixel of the left image
    UNIQUENESS = 7  # another disparity matches about as well
    SPECKLE = 8  # the match belongs to a patch that is too small
    BLANK = 9  # all pixels of the matching window have one gray value
    SKY = 10  # refinement removed a patch of sky or of overexposed pixels


def known(source: Any) -> Any:
    """Whether pixels have a disparity: a bool for one code of `PixelOrigin`, else an array of bool.

    Kernels compile this function as it stands, by `part(known)`.
    """
    return (source >= 1) & (source <= 3)
