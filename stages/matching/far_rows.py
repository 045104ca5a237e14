"""The rows of a frame that a map gains from at full size: far ground, but no farther than the map reaches.

A pixel of near ground is much smaller than a cell, and an error of a pixel is a small error of depth.
"""

from __future__ import annotations

import math

import numpy as np

from stages.data import Disparity, StereoCamera
from stages.matching.kernels.row_ranges import count_in_rows

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
    near = np.float32(math.sqrt(2 * scale / max_step) - shift)
    reach = np.float32(scale / max_depth - shift if max_depth else -math.inf)
    far, known, reached = count_in_rows(prior.pixels, prior.source, near, reach)
    needed = far > MAX_FAR_SHARE * known
    if max_depth:
        needed &= reached > MIN_REACHED_SHARE * prior.pixels.shape[1]
    rows = np.flatnonzero(needed)
    return (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, 0)
