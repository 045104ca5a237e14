"""PNG, read back by OpenCV and by Pillow."""

import io

import cv2
import numpy as np
import pytest
from PIL import Image

from recordings.png import png


@pytest.mark.parametrize("shape", [(1, 1), (61, 83)])
def test_other_readers_find_every_value(shape):
    pixels = np.random.default_rng(1).integers(0, 1 << 16, shape, np.uint16)
    blob = png(pixels)
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(blob, np.uint8), cv2.IMREAD_UNCHANGED), pixels)
    with Image.open(io.BytesIO(blob)) as image:
        image.verify()  # checksums of all parts
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(blob))), pixels)


@pytest.mark.parametrize("lie", [lambda pixels: pixels[::2, ::-1], lambda pixels: pixels.astype(">u2")])
def test_pixels_may_lie_in_memory_in_any_way(lie):
    pixels = lie(np.random.default_rng(2).integers(0, 1 << 16, (30, 40), np.uint16))
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(png(pixels), np.uint8), cv2.IMREAD_UNCHANGED), pixels)


@pytest.mark.parametrize("shape", [(33, 41, 3), (33, 41)])
def test_eight_bits_are_rgb_or_gray(shape):
    pixels = np.random.default_rng(3).integers(0, 256, shape, np.uint8)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(png(pixels)))), pixels)


@pytest.mark.parametrize("shape", [(3, 8), (33, 41)])
def test_true_and_false_are_white_and_black_in_one_bit(shape):
    pixels = np.random.default_rng(4).random(shape) < 0.5
    image = Image.open(io.BytesIO(png(pixels)))
    assert image.mode == "1"
    np.testing.assert_array_equal(np.asarray(image), pixels)
