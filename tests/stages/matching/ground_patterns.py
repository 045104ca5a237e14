"""Pairs of images of level ground with a painted pattern, and their true disparities."""

import numpy as np

from stages import StereoCamera, StereoFrame

WIDTH, HEIGHT, SAMPLES = 320, 240, 8
FOCAL, BASELINE, CAMERA_HEIGHT = 242.0, 0.24, 0.9  # px, m, m
ROWS_BELOW_HORIZON = 20  # of the first row


def stripes(period):
    """Stripes along the view, for `pattern_pair`; period: m."""
    return lambda x, _: np.sin(2 * np.pi * x / period)


def pattern_pair(pattern, contrast, noise=1.5, grains=0.0, seed=0):
    """A pair that sees the ground from a level camera, from 0.8 to 11 m, and its disparities (H, W).

    pattern: of x to the right and y along the view, m, between -1 and 1; contrast, noise: gray levels; grains:
    contrast of grains of 2 cm without a pattern.
    """
    rng = np.random.default_rng(seed)
    grain = rng.standard_normal((512, 512))
    y = FOCAL * CAMERA_HEIGHT / (np.arange(HEIGHT)[:, None] + ROWS_BELOW_HORIZON)
    disparity = FOCAL * BASELINE / y
    column = (np.arange(WIDTH * SAMPLES) + 0.5) / SAMPLES - 0.5 - WIDTH / 2
    images = []
    for shift in (0.0, 1.0):
        x = (column + shift * disparity) * y / FOCAL
        light = contrast * pattern(x, y)
        if grains:
            light = light + grains * grain[np.int64(x / 0.02) % 512, np.int64(y / 0.02) % 512]
        image = 120 + light.reshape(HEIGHT, WIDTH, SAMPLES).mean(axis=2) + noise * rng.standard_normal((HEIGHT, WIDTH))
        images.append(np.rint(image).clip(0, 255).astype(np.uint8))
    camera = StereoCamera(FOCAL, FOCAL, WIDTH / 2, -ROWS_BELOW_HORIZON, BASELINE, WIDTH, HEIGHT)
    return StereoFrame(1, *images, camera), np.broadcast_to(disparity, (HEIGHT, WIDTH))
