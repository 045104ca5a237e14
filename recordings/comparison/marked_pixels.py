"""A picture of an image in which some pixels are marked: the whole image and the part around them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from recordings.atomic_write import written
from recordings.export.page_layout import page_of
from recordings.png import chunk, png
from recordings.sinks.colormaps import top_eight_bits
from recordings.sinks.overwrite import PICTURE
from stages.data import Array

MARK = np.array([235, 40, 200], np.float32)  # RGB
PART_PX = 160  # width and height of the part that is enlarged, at least


def write_marked(path: Path, image: Array, pixels: Array, title: str) -> None:
    """Write a PNG file of an image, gray (H, W) or RGB (H, W, 3), uint8 or uint16, with a title above it.

    pixels: (N,) indices of the marked pixels in the flattened image.
    """
    (gray,) = top_eight_bits(image)
    rgb = np.repeat(gray[:, :, None], 3, axis=2) if gray.ndim == 2 else gray.copy()
    height, width = rgb.shape[:2]
    rows, cols = np.divmod(pixels, width)
    rgb[rows, cols] = (0.4 * rgb[rows, cols] + 0.6 * MARK).astype(np.uint8)
    if pixels.size:
        part = _around(rgb, rows, cols)
        corner = (int(cols.min()) - 3, int(rows.min()) - 3), (int(cols.max()) + 3, int(rows.max()) + 3)
        cv2.rectangle(rgb, *corner, MARK.tolist(), max(1, width // 640))
        zoomed = cv2.resize(part, (height, height), interpolation=cv2.INTER_NEAREST)
        rgb = np.hstack([rgb, np.full((height, 8, 3), 255, np.uint8), zoomed])
    with written(path) as temporary:
        temporary.write_bytes(_named(png(page_of(rgb, title, beside=1).pixels)))


def _around(rgb: Array, rows: Array, cols: Array) -> Array:
    """The part of an image around some pixels."""
    height, width = rgb.shape[:2]
    size = min(height, width, max(PART_PX, int(np.ptp(rows)) + 20, int(np.ptp(cols)) + 20))
    top = int(np.clip(rows.mean() - size / 2, 0, height - size))
    left = int(np.clip(cols.mean() - size / 2, 0, width - size))
    return rgb[top : top + size, left : left + size].copy()


def _named(picture: bytes) -> bytes:
    """A PNG file with the name of the program, by which a later picture may replace it."""
    header = 33  # bytes of the signature and the first chunk
    return picture[:header] + chunk(b"tEXt", PICTURE) + picture[header:]
