"""A scene of one gray and one disparity, for the tests of Refine."""

import numpy as np

from stages.data import StereoCamera, StereoFrame

SHAPE = HEIGHT, WIDTH = 120, 160


def flat_scene(level=8.0):
    """A frame of one gray, all of it matched at `level` with full confidence: (frame, pixels, source, confidence)."""
    image = np.full(SHAPE, 100, np.uint8)
    frame = StereoFrame(5, image, image, StereoCamera(300, 300, 80, 60, 0.1, WIDTH, HEIGHT))
    return frame, np.full(SHAPE, level, np.float32), np.ones(SHAPE, np.uint8), np.ones(SHAPE, np.float32)
