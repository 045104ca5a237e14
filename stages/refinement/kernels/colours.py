"""Colours packed into one number a pixel, so that a kernel loads a colour at once."""

from __future__ import annotations

import cv2
import numpy as np

from stages.compiled.jit import inlined_part
from stages.data import Array

BYTE, GREEN, BLUE = np.uint32(255), np.uint32(8), np.uint32(16)  # a channel's mask, and the channels' shifts


def packed(image: Array) -> Array:
    """The colours of a gray or RGB uint8 image, (H, W) uint32: one byte a channel."""
    form = cv2.COLOR_GRAY2RGBA if image.ndim == 2 else cv2.COLOR_RGB2RGBA
    colours: Array = cv2.cvtColor(image, form).view(np.uint32)[..., 0]
    return colours


@inlined_part
def levels_apart(one, other):
    """Levels between two packed colours in the channel that differs most.

    numba widens every sum to 64 bits; cut to 32 at once, sixteen of them fit a vector.
    """
    red = np.int32(np.int32(one & BYTE) - np.int32(other & BYTE))
    green = np.int32(np.int32((one >> GREEN) & BYTE) - np.int32((other >> GREEN) & BYTE))
    blue = np.int32(np.int32((one >> BLUE) & BYTE) - np.int32((other >> BLUE) & BYTE))
    return np.int32(max(abs(red), max(abs(green), abs(blue))))
