"""Pairs of images for the tests of matchers: textured surfaces whose disparities are known."""

import cv2
import numpy as np

from stages.data import PixelOrigin, StereoCamera, StereoFrame


def frame_of(left, right):
    height, width = left.shape[:2]
    return StereoFrame(3, left, right, StereoCamera(300, 300, width / 2, height / 2, 0.1, width, height))


def textured(height, width, seed=0):
    noise = np.random.default_rng(seed).uniform(0, 255, (height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.2)
    return np.clip((smooth - 127) * 3 + 127, 0, 255)


def slanted_pair(height=200, width=320, near=34.0, far=6.0):
    """A pair that sees a plane, d growing downwards from `far` to `near`, and its true disparities (H, W)."""
    wide = textured(height, width + 80)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    disparity = far + (near - far) * y / (height - 1)
    right = cv2.remap(wide, x + 40, y, cv2.INTER_CUBIC)
    left = cv2.remap(wide, x + 40 - disparity, y, cv2.INTER_CUBIC)  # x_right = x_left - d
    left, right = (np.round(image).clip(0, 255).astype(np.uint8) for image in (left, right))
    return frame_of(left, right), disparity


def check_in_view(result, least, most):
    """Known disparities lie within these and their partners in the right image; no other pixel has a confidence."""
    known = np.isfinite(result.pixels)
    partner = (np.arange(known.shape[1]) - result.pixels)[known]
    assert ((partner >= 0) & (partner <= known.shape[1] - 1)).all()
    assert ((result.pixels[known] >= least) & (result.pixels[known] <= most)).all()
    assert np.array_equal(result.source == PixelOrigin.MEASURED, known)
    assert (result.confidence[~known] == 0).all()
    return known
