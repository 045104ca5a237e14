"""Left-right check: each pixel compares its disparity with that of its partner in the right image."""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel, part
from stages.data import Array, PixelOrigin, known

F32 = np.float32
LEFT_RIGHT = int(PixelOrigin.LEFT_RIGHT)
_known = part(known)
Layers = tuple[Array, Array, Array]


def drop_inconsistent(found: Layers, backward: Layers, tolerance: float, max_disparity: float) -> Layers:
    """The layers of `found` without the pixels whose partner's disparity differs by more than `tolerance` px.

    Disparities above `max_disparity` px, and those whose partner is unknown or outside the image, are kept.
    found: pixels (H, W) float32, px, NaN = unknown; source (H, W) uint8; confidence (H, W) float32; backward: the same
    of the swapped frame, so mirrored.
    """
    left = np.empty_like(found[0]), np.empty_like(found[1]), np.empty_like(found[2])
    _drop(found, backward[:2], F32(tolerance), F32(max_disparity), left)
    return left


@kernel
def _drop(found, backward, tolerance, max_disparity, left):
    (pixels, source, confidence), (there_pixels, there_source) = found, backward
    left_pixels, left_source, left_confidence = left
    last = pixels.shape[1] - 1
    for y in range(pixels.shape[0]):
        for x in range(pixels.shape[1]):
            d = pixels[y, x]
            partner = np.rint(x - d)
            differs = False
            if d <= max_disparity and partner >= 0 and partner <= last:
                there = last - np.int64(partner)
                differs = _known(there_source[y, there]) and abs(there_pixels[y, there] - d) > tolerance
            left_pixels[y, x] = F32(np.nan) if differs else d
            left_source[y, x] = LEFT_RIGHT if differs else source[y, x]
            left_confidence[y, x] = F32(0) if differs else confidence[y, x]


def drop_inconsistent_reference(found: Layers, backward: Layers, tolerance: float, max_disparity: float) -> Layers:
    """`drop_inconsistent` in plain numpy."""
    pixels = found[0]
    theirs = np.where(known(backward[1]), backward[0], F32(np.nan))[:, ::-1]
    partner = np.rint(np.arange(pixels.shape[1]) - pixels.astype(np.float64))
    inside = (partner >= 0) & (partner < pixels.shape[1])
    asked = np.take_along_axis(theirs, np.where(inside, partner, 0).astype(int), axis=1)
    with np.errstate(invalid="ignore"):
        wrong = inside & (pixels <= max_disparity) & (np.abs(asked - pixels) > F32(tolerance))
    left = [layer.copy() for layer in found]
    left[0][wrong], left[1][wrong], left[2][wrong] = np.nan, LEFT_RIGHT, 0
    return left[0], left[1], left[2]
