"""What texture allows: information, expected variance of a match, noise of two images, the sky."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages.matching.kernels.texture import (
    BLOCK,
    contrast,
    gradient,
    information,
    match_variance,
    sky_end,
    stereo_noise,
)
from stages.matching.kernels.texture import information_reference as plain_information

NOISE = np.full(256, 1.5, np.float32)


def noisy(shape, sigma=1.5, seed=0, level=120.0, contrast=0.0):
    """An image of white noise on smooth texture of a contrast, gray levels."""
    rng = np.random.default_rng(seed)
    texture = cv2.GaussianBlur(np.random.default_rng(77).standard_normal(shape), (0, 0), 2)
    picture = level + contrast * texture / texture.std() + sigma * rng.standard_normal(shape)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


@given(st.integers(1, 30), st.integers(1, 40), st.integers(0, 2**31), st.sampled_from([1, 2]))
def test_information_equals_the_reference(height, width, seed, threads):
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, (height, width), np.uint8)
    noise = rng.uniform(0.3, 5, 256).astype(np.float32)
    found = information(image, gradient(image), noise, threads)
    assert np.allclose(found, plain_information(image, gradient(image), noise), rtol=1e-4, atol=1e-2)


def test_noise_alone_contains_no_information():
    images = noisy((400, 400)), noisy((400, 400), contrast=6.0)
    bare, textured = (information(image, gradient(image), NOISE)[0].sum() for image in images)
    assert abs(bare) < 0.02 * textured


def test_a_match_is_the_more_uncertain_the_weaker_the_texture():
    images = [noisy((80, 80), contrast=contrast) for contrast in (0.0, 1.0, 3.0, 12.0)]
    sigmas = [float(np.sqrt(np.median(match_variance(information(i, gradient(i), NOISE))))) for i in images]
    assert sigmas == sorted(sigmas, reverse=True)
    assert sigmas[0] > 0.5
    assert sigmas[-1] < 0.1


@pytest.mark.parametrize("sigma", [1.5, 4.5])
def test_the_noise_of_two_images_is_what_they_do_not_share(sigma):
    left, right = (noisy((320, 400), sigma=sigma, seed=seed, contrast=5.0) for seed in (1, 2))
    none_moved = np.zeros(left.shape, np.float32)
    noise = stereo_noise(none_moved, left, (gradient(left), gradient(right)), NOISE)
    assert np.allclose(noise, sigma, rtol=0.1)


def test_the_noise_of_two_images_is_at_least_that_of_one():
    left = noisy((320, 400), contrast=5.0)
    for disparity in (0, np.nan):  # of images without a difference, and without a match
        pixels = np.full(left.shape, disparity, np.float32)
        assert np.array_equal(stereo_noise(pixels, left, (gradient(left),) * 2, NOISE), NOISE)


def test_ground_begins_where_texture_or_brightness_ends_the_sky():
    sky, blank = noisy((200, 240), contrast=0.0), np.full((200, 240), 90, np.uint8)
    textured = noisy((200, 240), contrast=20.0, seed=3)
    for above, first, within in ((sky, 120, BLOCK), (sky + 60, 122, 1)):  # the block from row 120 on shows sky as well
        image = np.concatenate([above[:first], textured[first:]])
        found = sky_end(information(image, gradient(image), NOISE), image, NOISE)
        assert np.mean(abs(found - first) <= within) > 0.9
    assert (sky_end(information(blank, gradient(blank), NOISE), blank, NOISE) == 200).all()


def test_the_contrast_of_bands_is_that_of_the_image():
    image = noisy((31, 40))
    bands = [contrast(image, first, min(first + 4, 31)) for first in range(0, 31, 4)]
    assert np.array_equal(np.concatenate(bands), contrast(image, 0, 31))
