"""Ground that repeats itself, such as stripes along the line of sight: its matches may be a period off.

On a regular pattern the whole ground fits as well a period nearer or farther, so no check of neighbours, of both views
or of the confidence finds it. But some matches, searched along their whole row, have a rival there.
"""

from __future__ import annotations

import numpy as np

from stages.data import Array, Disparity, PixelOrigin, StereoFrame
from stages.matching.image_noise import frame_noise
from stages.matching.intensity import gray_pair
from stages.matching.kernels.rivals import HALF_ROWS, find_rivals

GRID = 27, 37  # rows and columns of pixels in the image, from which samples are taken
MAX_SAMPLES, MIN_SAMPLES = 100, 16  # matches of a frame
MIN_HALF_WIDTH, WIDTH_SHARE = 8, 1 / 32  # px; of the image's width: half the width of a window
REACH_SHARE = 1 / 4  # of the image's width: the largest disparity searched
MIN_TEXTURE = 6.0  # standard deviations of the noise, of a window that another texture cannot match by chance
MAX_MISMATCH = 0.2  # of the texture, that a match leaves unexplained; more is a depth edge, a reflection, a mismatch
MAX_RIVAL_COST = 0.05  # of the texture, that a rival may explain less than the match


def repeated_share(frame: StereoFrame, disparity: Disparity) -> float:
    """Share of the sampled matches that have a rival as good at another disparity; NaN if few can be tested."""
    height, width = disparity.pixels.shape
    half_width = max(MIN_HALF_WIDTH, 2 * round(WIDTH_SHARE * width / 2))
    if width < 4 * half_width or height < 2 * HALF_ROWS + 1:
        return np.nan
    samples = _matched(disparity, _grid(height, width, half_width))
    camera = frame.camera
    texture, found, rival = find_rivals(
        frame.once(gray_pair), disparity.pixels, samples, frame.once(frame_noise), half_width,
        camera.cx - camera.cx_right, round(REACH_SHARE * width),
    )  # fmt: skip
    noise = (2 * HALF_ROWS + 1) * (2 * half_width - 1)  # the part of texture and costs that is noise
    texture = texture - noise
    tested = texture > MIN_TEXTURE * np.sqrt(2 * noise)
    tested &= found - noise < MAX_MISMATCH * texture
    if np.count_nonzero(tested) < MIN_SAMPLES:
        return np.nan
    return float(np.mean((rival - found < MAX_RIVAL_COST * texture)[tested]))


def _grid(height: int, width: int, half_width: int) -> Array:
    """Row and column of pixels whose window is in the image, (N, 2)."""
    rows, columns = GRID
    y = np.linspace(HALF_ROWS, height - 1 - HALF_ROWS, rows).astype(np.int64)
    x = np.linspace(half_width, width - 1 - half_width, columns).astype(np.int64)
    return np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1).reshape(-1, 2)


def _matched(disparity: Disparity, grid: Array) -> Array:
    """Up to `MAX_SAMPLES` pixels of the grid that are matched, spread evenly."""
    place = grid[:, 0], grid[:, 1]
    source = disparity.source[place]
    matched = (source == PixelOrigin.MEASURED) | (source == PixelOrigin.PLANE)
    samples: Array = grid[matched & np.isfinite(disparity.pixels[place])]
    if len(samples) > MAX_SAMPLES:
        samples = samples[np.linspace(0, len(samples) - 1, MAX_SAMPLES).astype(np.int64)]
    return samples
