"""A scene of one gray and one disparity, for the tests of Refine."""

import numpy as np

from stages.data import StereoCamera, StereoFrame
from tests.stages.builders import disparity_of

SHAPE = HEIGHT, WIDTH = 120, 160
CAMERA = StereoCamera(300, 300, 80, 60, 0.1, WIDTH, HEIGHT)
GRAY = StereoFrame(5, *np.full((2, *SHAPE), 100, np.uint8), CAMERA)


def flat(level=8.0):
    return np.full(SHAPE, level, np.float32)


def matched(pixels, confidence=None):
    """Matches of the frame, with full confidence by default."""
    return disparity_of(pixels, confidence=confidence, stamp=5)
