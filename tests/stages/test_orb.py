"""ORB features: of strong and weak texture, and of images without any."""

import cv2
import numpy as np
import pytest

from stages.orb import FAST_THRESHOLDS, orb_features


def textured(contrast: float) -> np.ndarray:
    """A random image (240, 320) uint8 with blobs of a few pixels and this standard deviation, gray levels."""
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(240, 320)), (0, 0), 1.5)
    return np.clip(120 + contrast * noise / noise.std(), 0, 255).round().astype(np.uint8)


def test_strong_texture_has_the_features_of_the_higher_threshold() -> None:
    image = textured(30)
    pixels, descriptors = orb_features(image, 200, scale=1.3, levels=3)
    detector = cv2.ORB.create(200, scaleFactor=1.3, nlevels=3, fastThreshold=max(FAST_THRESHOLDS))
    found, expected = detector.detectAndCompute(image, None)
    assert np.array_equal(pixels, cv2.KeyPoint.convert(found))
    assert np.array_equal(descriptors, expected)


def test_weak_texture_has_features_too() -> None:
    image = textured(6)
    high = cv2.ORB.create(200, fastThreshold=max(FAST_THRESHOLDS)).detect(image, None)
    pixels, descriptors = orb_features(image, 200, scale=1.3, levels=3)
    assert len(high) < 50
    assert len(pixels) > 150
    assert descriptors.shape == (len(pixels), 32)


@pytest.mark.parametrize("shape", [(1, 1), (20, 300), (100, 100)])
def test_an_image_without_corners_has_no_features(shape: tuple[int, int]) -> None:
    pixels, descriptors = orb_features(np.full(shape, 90, np.uint8), 200, scale=1.3, levels=3)
    assert pixels.shape == (0, 2)
    assert descriptors.shape == (0, 32)
