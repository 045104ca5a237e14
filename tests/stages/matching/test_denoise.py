"""Noise is removed before a match as far as it exceeds detail; texture that both images share is no noise."""

import cv2
import numpy as np
import pytest

from stages import Match, StereoCamera, StereoFrame
from stages.matching.denoise import denoised
from stages.matching.kernels.texture import without_noise, without_noise_reference
from tests.stages.builders import disparity_of

WIDTH, HEIGHT, SHIFT = 320, 240, 12


def pair(contrast, noise, step=0.0, blur=1.5, seed=0):
    """Left and right image of a flat texture with a disparity of SHIFT; `step`: a rise of brightness in the middle."""
    rng = np.random.default_rng(seed)
    texture = cv2.GaussianBlur(rng.standard_normal((HEIGHT, WIDTH + SHIFT)), (0, 0), blur)
    scene = 110 + contrast * texture / texture.std() + step * (np.arange(WIDTH + SHIFT) >= WIDTH // 2)
    views = (scene[:, :WIDTH], scene[:, SHIFT:])
    return tuple(np.rint(view + noise * rng.standard_normal(view.shape)).astype(np.uint8) for view in views)


def clean(images, noise):
    """The images without this noise, the same at all gray levels."""
    return denoised(images, np.full(256, noise, np.float32))


def match(images, denoise):
    """Disparities near a prior of SHIFT, away from the image's border."""
    camera = StereoCamera(fx=300.0, fy=300.0, cx=160.0, cy=120.0, baseline=0.1, width=WIDTH, height=HEIGHT)
    prior = disparity_of(np.full((HEIGHT, WIDTH), SHIFT), stamp=7)
    stage = Match(disparities=32, denoise=denoise, prior_weight=0.1, weak_texture_gain=1)
    return stage(StereoFrame(7, *images, camera), prior).pixels[8:-8, 40:-8]


@pytest.mark.parametrize("shape", [(1, 1), (2, 9), (17, 3), (40, 57)])
def test_gray_levels_equal_the_reference(shape):
    rng = np.random.default_rng(shape[1])
    image = rng.integers(0, 256, shape, np.uint8)
    image[: shape[0] // 2] = image[: shape[0] // 2] // 64 + 100
    variance = rng.uniform(0, 40, 256).astype(np.float32)
    assert np.abs(without_noise(image, variance) - without_noise_reference(image, variance)).max() < 0.501


def test_noise_without_texture_is_reduced_to_half():
    noisy = pair(contrast=0, noise=4)
    assert (np.std(clean(noisy, 4), axis=(1, 2)) < 0.5 * np.std(noisy, axis=(1, 2))).all()


def test_an_edge_keeps_its_place_and_its_height():
    rows = clean(pair(contrast=0, noise=3, step=80), 3)[0].mean(axis=0)
    assert rows[WIDTH // 2 - 1 : WIDTH // 2 + 1] == pytest.approx([110, 190], abs=2)


def test_texture_stronger_than_noise_stays():
    noisy = pair(contrast=25, noise=3)
    assert np.abs(np.subtract(clean(noisy, 3)[0], noisy[0], dtype=float)).mean() < 1.5


def test_images_with_little_noise_are_the_same_images():
    images = pair(contrast=10, noise=1)
    assert clean(images, 1.2) is images


def test_weak_texture_under_noise_is_matched_with_fewer_errors():
    noisy = pair(contrast=4, noise=4)
    wrong = {denoise: np.mean(~(np.abs(match(noisy, denoise) - SHIFT) <= 1)) for denoise in (False, True)}
    assert wrong[False] > 0.05
    assert wrong[True] < 0.75 * wrong[False]


def test_texture_as_fine_as_noise_is_kept_where_both_images_share_it():
    dots = pair(contrast=12, noise=0, blur=0.1)
    np.testing.assert_array_equal(match(dots, denoise=True), match(dots, denoise=False))
