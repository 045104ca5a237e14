"""Disparity images, the origin of each pixel, and the matched share of the nearest ground."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from stages.data.arrays import Array, publish, publish_stamp
from stages.data.camera import StereoCamera


class PixelOrigin(IntEnum):
    """Where a disparity comes from, or why a pixel has none: the codes of `Disparity.source`."""

    UNKNOWN = 0  # no disparity; the reason is not recorded
    MEASURED = 1  # matched at this pixel
    PLANE = 2  # taken from a plane through neighbouring matches, which replaces a missing or inconsistent match
    FILLED = 3  # guessed from neighbouring disparities
    OUT_OF_VIEW = 4  # the partner lies at or beyond the border of the right image
    OUT_OF_RANGE = 5  # the match lies at or beyond an end of the search range, beyond max_depth, or off the prior
    LEFT_RIGHT = 6  # the right image's pixel matches a different pixel of the left image
    UNIQUENESS = 7  # another disparity matches about as well
    SPECKLE = 8  # the match belongs to a patch that is too small
    BLANK = 9  # all pixels of the matching window have one gray value
    SKY = 10  # refinement removed a patch of sky or of burnt-out pixels


def known(source: Any) -> Any:
    """Whether pixels have a disparity: a bool for one code of `PixelOrigin`, else an array of bool.

    Kernels compile this function as it stands, by `part(known)`.
    """
    return (source >= 1) & (source <= 3)


@dataclass(frozen=True, eq=False)
class Disparity:
    """A disparity image in the left rectified frame.

    Parameters
    ----------
    stamp
        Nanoseconds.
    pixels
        (H, W) float32, px, NaN = unknown.
    source
        (H, W) uint8, codes of `PixelOrigin`; see `known`.
    confidence
        (H, W) float32 in [0, 1].
    segments
        (H, W) int32 superpixel labels of refinement, or None.
    camera
        The rectified camera, if it is known.

    Examples
    --------
    >>> import numpy as np
    >>> from stages import Disparity, PixelOrigin, known
    >>> pixels = np.array([[12.5, np.nan]], np.float32)
    >>> source = np.array([[PixelOrigin.MEASURED, PixelOrigin.SPECKLE]], np.uint8)
    >>> known(Disparity(0, pixels, source, np.array([[0.9, 0.0]], np.float32)).source)
    array([[ True, False]])
    """

    stamp: int
    pixels: Array
    source: Array
    confidence: Array
    segments: Array | None = None
    camera: StereoCamera | None = None

    def __post_init__(self) -> None:
        publish_stamp(self)
        publish(self, "pixels", (None, None), np.float32)
        publish(self, "source", self.pixels.shape, np.uint8)
        publish(self, "confidence", self.pixels.shape, np.float32)
        if self.segments is not None:
            publish(self, "segments", self.pixels.shape, np.int32)


@dataclass(frozen=True)
class MatchHealth:
    """The matched shares of all pixels of a frame (`all`) and of the nearest ground in view (`near`)."""

    stamp: int
    all: float
    near: float

    def __post_init__(self) -> None:
        publish_stamp(self)
