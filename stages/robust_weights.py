"""Weights of robust least squares."""

from __future__ import annotations

import numpy as np

from stages.data import Array

MAD_TO_SIGMA = 1.4826  # standard deviation over median magnitude, of normal errors
TUKEY_CUTOFF = 4.685  # standard deviations; beyond it the weight is 0


def tukey_weights(errors: Array, scale: float) -> Array:
    """Tukey's biweight (N,) of errors (N,) with standard deviation `scale`: 1 for no error, 0 for outliers."""
    weights: Array = np.square(np.clip(1 - np.square(errors / (TUKEY_CUTOFF * scale)), 0, None))
    return weights
