"""Intensity: an image of any depth becomes 8 bit by what it holds, and its partner of the same exposure likewise."""

import numpy as np
import pytest

from stages.matching.intensity import alike, eight_bit, gray


def test_eight_bit_images_pass_untouched():
    image = np.arange(256, dtype=np.uint8).reshape(16, 16)
    assert eight_bit(image, image) == (image, image)


def test_percentiles_of_all_images_together_become_black_and_white():
    left, right = np.random.default_rng(0).integers(900, 3000, (2, 200, 300)).astype(np.uint16)
    right += 500
    low, high = np.percentile([left, right], (0.1, 99.9))
    for image, got in zip((left, right), eight_bit(left, right), strict=True):
        want = np.clip((image - low) * 255 / (high - low), 0, 255)
        assert got.dtype == np.uint8
        assert np.abs(got - want).max() < 1


def test_a_few_dead_pixels_do_not_set_the_range():
    image = np.full((100, 100), 1000, np.uint16)
    image[:50] = 2000
    image[0, :5], image[99, :5] = 65535, 0
    stretched = eight_bit(image)[0]
    assert (stretched[1:50] == 255).all()
    assert (stretched[50:99] == 0).all()


@pytest.mark.parametrize("level", [0, 700, 65535])
def test_a_uniform_image_stays_uniform(level):
    assert len(np.unique(eight_bit(np.full((4, 5, 3), level, np.uint16))[0])) == 1


def test_both_images_become_gray_where_one_is():
    colour = np.random.default_rng(0).integers(0, 256, (4, 5, 3)).astype(np.uint8)
    for left, right in ((colour, gray(colour)), (gray(colour), colour)):
        assert all(np.array_equal(image, gray(colour)) for image in alike(left, right))
    assert alike(colour, colour) == (colour, colour)


def test_green_is_the_brightest_part_of_gray_and_gray_stays_gray():
    pure = np.eye(3, dtype=np.uint8)[None] * 255
    assert gray(pure).tolist() == [[76, 150, 29]]
    assert gray(pure[..., 0]).tolist() == pure[..., 0].tolist()
