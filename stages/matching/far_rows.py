"""The rows of a frame that a map gains from at full size: far ground, but no farther than the map reaches.

A pixel of near ground is much smaller than a cell, and an error of a pixel is a small error of depth.
"""

from __future__ import annotations

import math

import numpy as np

from stages.data import Disparity, PixelOrigin, StereoCamera

MAX_FAR_SHARE = 0.1  # of the known pixels of a near row
MIN_REACHED_SHARE = 0.01  # of all pixels of a row that the map reaches


def far_rows(prior: Disparity, camera: StereoCamera, max_step: float, max_depth: float) -> tuple[int, int]:
    """The first of the rows and the one after the last, the same if there are none.

    prior: at full size, from one of half size. The rows begin with the first one that has more than specks measured
    nearer than `max_depth`, m (0: no limit). They end with the last one that is far: where over a tenth has a step of
    depth of more than `max_step`, m, from pixel to pixel of half size.
    """
    scale, shift = camera.fx * camera.baseline, camera.cx_right - camera.cx  # depth Z = scale / (d + shift)
    # A step of 2 px at depth Z is 2 Z^2 / scale.
    far = prior.pixels < math.sqrt(2 * scale / max_step) - shift
    needed = np.count_nonzero(far, axis=1) > MAX_FAR_SHARE * np.count_nonzero(np.isfinite(prior.pixels), axis=1)
    if max_depth:
        reached = (prior.pixels > scale / max_depth - shift) & (prior.source == PixelOrigin.MEASURED)
        needed &= np.count_nonzero(reached, axis=1) > MIN_REACHED_SHARE * reached.shape[1]
    rows = np.flatnonzero(needed)
    return (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, 0)
