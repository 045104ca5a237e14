"""Data of any stage with plain defaults, so that a test states only what matters to it."""

import numpy as np

from stages import Disparity, PointCloud
from stages.data import LEVEL_FRAME


def disparity_of(pixels, source=None, confidence=None, stamp=0, **others):
    """Disparities; source and confidence, (H, W) or one for all, default to MEASURED and 1 where known, else 0."""
    pixels = np.asarray(pixels, np.float32)
    known = np.isfinite(pixels)
    codes, trust = (np.broadcast_to(known if given is None else given, known.shape) for given in (source, confidence))
    return Disparity(stamp, pixels, codes.astype(np.uint8), trust.astype(np.float32), **others)


def cloud_of(points, sigma=0.02, frame_id=LEVEL_FRAME, stamp=5, colors=None, **others):
    """Points with these standard deviations, (N,) or one for all; black by default."""
    n = len(points)
    colors = np.zeros((n, 3), np.uint8) if colors is None else colors
    points, sigmas = np.asarray(points, np.float32), np.full(n, sigma, np.float32)
    return PointCloud(stamp, points, colors, sigmas, np.arange(n, dtype=np.int32), frame_id, **others)
