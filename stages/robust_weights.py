"""Weights of robust least squares."""

from __future__ import annotations

import numpy as np

from stages.data import Array

NORMAL = 1.4826  # standard deviations of normal errors in their median magnitude
TUKEY = 4.685  # standard deviations, beyond which an outlier has no weight


def tukey_weights(errors: Array, scale: float) -> Array:
    """Tukey's biweight of errors (N,) whose standard deviation, but for outliers, is `scale`: (N,), 1 at none."""
    weights: Array = np.square(np.clip(1 - np.square(errors / (TUKEY * scale)), 0, None))
    return weights
