"""The noise of an image is found from the image, whatever it shows."""

import cv2
import numpy as np
import pytest
from scipy.optimize import nnls

from stages import MeasureNoise, StereoCamera, StereoFrame
from stages.matching.image_noise import noise_levels, nonnegative_pair


def ground(shape=(480, 640), seed=0):
    """Smooth ground with a tenth of its area strewn with coarse gravel: gray levels, float."""
    rng = np.random.default_rng(seed)
    smooth = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), 25)
    grit = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), 1.5)
    patches = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), 40)
    strewn = patches > np.quantile(patches, 0.9)
    return 110 + 25 * smooth / smooth.std() + 12 * strewn * grit / grit.std()


@pytest.mark.parametrize("sigma", [0.7, 1.5, 3.0, 6.0])
def test_white_noise_on_ground_is_found_within_a_tenth(sigma):
    scene = ground()
    image = np.rint(scene + sigma * np.random.default_rng(1).standard_normal(scene.shape)).astype(np.uint8)
    assert noise_levels(image)[110] == pytest.approx(np.hypot(sigma, np.sqrt(1 / 12)), rel=0.1)


def test_shot_noise_grows_with_brightness():
    scene = np.tile(np.linspace(30, 220, 640), (480, 1))
    sigma = np.sqrt(0.5 + 0.03 * scene)
    image = np.rint(scene + sigma * np.random.default_rng(2).standard_normal(scene.shape)).astype(np.uint8)
    found = noise_levels(image)
    for level in (50, 125, 200):
        assert found[level] == pytest.approx(np.sqrt(0.5 + 0.03 * level + 1 / 12), rel=0.1)


@pytest.mark.parametrize("image", [np.zeros((40, 40), np.uint8), np.full((40, 40), 255, np.uint8),
                                   np.full((5, 5), 90, np.uint8), np.full((64, 64), 90, np.uint8)])  # fmt: skip
def test_an_image_without_noise_has_that_of_rounding(image):
    assert np.allclose(noise_levels(image), np.sqrt(1 / 12))


def test_the_stage_measures_the_left_image_in_gray():
    camera = StereoCamera(fx=300.0, fy=300.0, cx=160.0, cy=120.0, baseline=0.1, width=320, height=240)
    gray = np.rint(np.random.default_rng(3).normal(120, 2, (240, 320))).astype(np.uint8)
    color = np.repeat(gray[:, :, None], 3, axis=2)
    noise = MeasureNoise()(StereoFrame(7, color, color, camera))
    assert noise.stamp == 7
    assert np.allclose(noise.sigma, noise_levels(gray), rtol=0.05)


@pytest.mark.parametrize("size", [1, 2, 9])
def test_a_pair_without_negatives_is_that_of_scipy(size):
    rng = np.random.default_rng(size)
    for _ in range(200):
        terms = np.stack([np.ones(size), rng.uniform(1, 255, size)], axis=1) * rng.uniform(0, 2, (size, 1))
        values = rng.normal(0, 1, size) * rng.uniform(0, 3)
        np.testing.assert_allclose(nonnegative_pair(terms, values), nnls(terms, values)[0], rtol=1e-6, atol=1e-9)
    assert nonnegative_pair(np.zeros((3, 2)), np.ones(3)) == (0, 0)
