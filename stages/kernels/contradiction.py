"""Where the disparity of the right image contradicts that of the left: each pixel asks its partner for its own."""

from __future__ import annotations

import numpy as np

from stages.data import Array
from stages.kernels.compiled import kernel
from stages.kernels.halves import pairs


def contradicted(pixels: Array, backward: Array, tolerance: float, threads: int = 1) -> Array:
    """Whether the partner's disparity differs by more than `tolerance` px, (H, W) bool.

    pixels: (H, W) float32, px, NaN = unknown; backward: the same of the swapped frame, that is, mirrored. An unknown
    disparity, and one whose partner is outside the image, contradicts and is contradicted by nothing.
    """
    wrong = np.empty(pixels.shape, np.bool_)
    middle = len(pixels) // 2
    limit = np.float32(tolerance)
    with pairs(threads) as both:
        both(
            lambda: _compare(pixels[:middle], backward[:middle], limit, wrong[:middle]),
            lambda: _compare(pixels[middle:], backward[middle:], limit, wrong[middle:]),
        )
    return wrong


@kernel
def _compare(pixels, backward, tolerance, wrong):  # type: ignore[no-untyped-def]
    last = pixels.shape[1] - 1
    for y in range(pixels.shape[0]):
        for x in range(pixels.shape[1]):
            d = pixels[y, x]
            partner = np.rint(x - d)
            differs = False
            if partner >= 0 and partner <= last:
                differs = abs(backward[y, last - np.int64(partner)] - d) > tolerance
            wrong[y, x] = differs


def contradicted_reference(pixels: Array, backward: Array, tolerance: float) -> Array:
    """`contradicted` in plain numpy."""
    right = backward[:, ::-1]
    partner = np.rint(np.arange(pixels.shape[1]) - pixels.astype(np.float64))
    inside = (partner >= 0) & (partner < pixels.shape[1])
    theirs = np.take_along_axis(right, np.where(inside, partner, 0).astype(int), axis=1)
    with np.errstate(invalid="ignore"):
        wrong: Array = inside & (np.abs(theirs - pixels) > np.float32(tolerance))
    return wrong
