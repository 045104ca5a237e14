"""Some rows of a frame and of its disparity image, to work on these only, and the way back to the whole image."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from stages.data.camera import StereoFrame
from stages.data.disparity import Disparity


def frame_rows(frame: StereoFrame, first: int, end: int) -> StereoFrame:
    """Rows `first` to `end` of a frame, as a frame of their own: cy of its camera counts from `first`."""
    camera = replace(frame.camera, cy=frame.camera.cy - first, height=end - first)
    return StereoFrame(frame.stamp, frame.left[first:end], frame.right[first:end], camera)


def disparity_rows(disparity: Disparity, first: int, end: int) -> Disparity:
    """Pixels, source and confidence of rows `first` to `end`."""
    rows = slice(first, end)
    return Disparity(disparity.stamp, disparity.pixels[rows], disparity.source[rows], disparity.confidence[rows])


def rows_without_sigma(disparity: Disparity) -> range:
    """The rows of a partly refined disparity image that are to be refined; no row of any other image.

    A row with known pixels but no sigma marks such an image. The range contains all rows without sigma.
    """
    if disparity.sigma is None:
        return range(0)
    without = np.isnan(disparity.sigma).all(axis=1)
    if not np.isfinite(disparity.pixels[without]).any():
        return range(0)
    rows = np.flatnonzero(without)
    return range(rows[0], rows[-1] + 1) if 0 < len(rows) < len(disparity.pixels) else range(0)


def with_rows(whole: Disparity, first: int, part: Disparity) -> Disparity:
    """`whole` with the rows of `part` from row `first` on.

    A layer that only one of them has is NaN, -1 (segments) or 255 (costs) in the rows of the other.
    """
    unknown = {"sigma": np.float32(np.nan), "segments": np.int32(-1), "costs": np.uint8(255)}
    layers: dict[str, Any] = {}
    end = first + len(part.pixels)
    for name in ("pixels", "source", "confidence", *unknown):
        old, new = getattr(whole, name), getattr(part, name)
        if old is None and new is None:
            continue
        like = new if old is None else old
        layers[name] = np.empty((*like.shape[:-2], *whole.pixels.shape), like.dtype)
        for rows in (np.s_[..., :first, :], np.s_[..., end:, :]):
            layers[name][rows] = unknown[name] if old is None else old[rows]
        layers[name][..., first:end, :] = unknown[name] if new is None else new
    return replace(whole, **layers)
