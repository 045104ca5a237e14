"""Disparity images, the origin of each pixel, and how well the nearest ground was matched."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from stages.data.arrays import Array, publish, publish_stamp
from stages.data.camera import StereoCamera


class PixelOrigin(IntEnum):
    """Where a disparity comes from, the codes of `Disparity.source`.

    MEASURED: matched at this pixel; PLANE: the surface that the matches about it agree on, be there no match at this
    pixel or one that disagrees; FILLED: guessed from beside.
    """

    UNKNOWN = 0
    MEASURED = 1
    PLANE = 2
    FILLED = 3


@dataclass(frozen=True, eq=False)
class Disparity:
    """A disparity image in the left rectified frame.

    pixels: (H, W) float32, px, NaN = unknown; source: (H, W) uint8, codes of `PixelOrigin`; confidence: (H, W) float32
    in [0, 1]; segments: (H, W) int32 superpixel labels where refinement made them, else None; camera: the rectified
    camera it was made for, where known.
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
    """How much of a frame is matched: shares of all pixels and of those of the nearest ground in view."""

    stamp: int
    all: float
    near: float

    def __post_init__(self) -> None:
        publish_stamp(self)
