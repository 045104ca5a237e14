"""Removal of sensor noise before a match: fine detail is kept as far as its power exceeds that of the noise.

The costs of a match compare neighbours, so noise reaches them undamped. Where the detail of a neighbourhood has little
more power than noise alone, it says nothing about the disparity (J.-S. Lee, "Digital Image Enhancement and Noise
Filtering by Use of Local Statistics", PAMI 2(2), 1980).
"""

from __future__ import annotations

import numpy as np

from stages.compiled.parallel import shared_by
from stages.data import Array
from stages.matching.kernels.texture import WEIGHTS, without_noise

# Of white noise of variance 1, the variance of its detail.
SHARE = 1 - 2 * WEIGHTS[0] ** 2 + (2 * np.square(WEIGHTS).sum() - WEIGHTS[0] ** 2) ** 2
# Gray levels. Removing weaker noise costs a match more in fine texture than it gains, on indoor scenes above all.
HARMLESS_NOISE = 1.25


def denoised(images: tuple[Array, Array], noise: Array, threads: int = 1) -> tuple[Array, Array]:
    """The images of a pair with less noise; where none of the noise does harm, the very same images.

    images: left and right, (H, W) uint8; noise: (256,) float32, its standard deviation at each gray level.
    """
    excess = np.maximum(np.square(noise) - np.float32(HARMLESS_NOISE**2), 0)
    if not excess[: int(images[0].max()) + 1].any():
        return images
    (left, right), variance = images, excess * np.float32(SHARE)
    return shared_by(threads)(lambda: without_noise(left, variance), lambda: without_noise(right, variance))
