"""Disparity images, the origin of each pixel, and the matched share of the nearest ground."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stages.data.arrays import Array, publish, publish_plain
from stages.data.camera import StereoCamera


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
    sigma
        (H, W) float32, px, standard deviation of a known disparity that is not a mismatch (inf = no evidence, NaN = not
        known yet), or None.
    costs
        (2, H, W) uint8: the smallest sum of costs that the search found at a pixel, and the smallest of all disparities
        but that one and its neighbours; 255 is 255 or more. None if they were not kept.

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
    sigma: Array | None = None
    costs: Array | None = None

    def __post_init__(self) -> None:
        publish_plain(self)
        publish(self, "pixels", (None, None), np.float32)
        publish(self, "source", self.pixels.shape, np.uint8)
        publish(self, "confidence", self.pixels.shape, np.float32)
        if self.segments is not None:
            publish(self, "segments", self.pixels.shape, np.int32)
        if self.sigma is not None:
            publish(self, "sigma", self.pixels.shape, np.float32)
        if self.costs is not None:
            publish(self, "costs", (2, *self.pixels.shape), np.uint8)


@dataclass(frozen=True)
class MatchHealth:
    """The matched shares of a frame's pixels.

    Parameters
    ----------
    stamp : int
        That of the frame, ns.
    all, near : float
        Matched share of all pixels, and of those of the nearest ground in view.
    repeated : float
        Share of the sampled matches that have a rival as good at another disparity; NaN if it was not tested.
    """

    stamp: int
    all: float
    near: float
    repeated: float = math.nan

    def __post_init__(self) -> None:
        publish_plain(self)
