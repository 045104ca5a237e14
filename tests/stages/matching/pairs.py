"""Pairs of images for the tests of matchers: textured surfaces whose disparities are known."""

import hashlib
from dataclasses import replace

import cv2
import numpy as np

from stages import Match
from stages.data import PixelOrigin, StereoCamera, StereoFrame


def frame_of(left, right):
    height, width = left.shape[:2]
    return StereoFrame(3, left, right, StereoCamera(300, 300, width / 2, height / 2, 0.1, width, height))


def textured(height, width, seed=0):
    noise = np.random.default_rng(seed).uniform(0, 255, (height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.2)
    return np.clip((smooth - 127) * 3 + 127, 0, 255)


def slanted(height=200, width=320, near=34.0, far=6.0):
    """A pair that sees a plane, d growing downwards from `far` to `near`, and its true disparities (H, W)."""
    wide = textured(height, width + 80)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    disparity = far + (near - far) * y / (height - 1)
    right = cv2.remap(wide, x + 40, y, cv2.INTER_CUBIC)
    left = cv2.remap(wide, x + 40 - disparity, y, cv2.INTER_CUBIC)  # x_right = x_left - d
    left, right = (np.round(image).clip(0, 255).astype(np.uint8) for image in (left, right))
    return frame_of(left, right), disparity


SLOPE, TRUTH = slanted()
_right = SLOPE.right.copy()
_right[60:120, 100:200] = textured(60, 100, seed=5)
SPOILED = replace(SLOPE, right=_right)  # a patch differs between its images


def accuracy(pixels, truth, where=np.s_[:]):
    """Share of these pixels that are known, the median of their errors, px, and the share of errors above 1 px."""
    error = np.abs(pixels - truth)[where]
    known = error[np.isfinite(error)]
    return known.size / error.size, np.median(known), (known > 1).mean()


def digest():
    """SHA-256 of the disparities of several searches, hexadecimal."""
    frame, _ = slanted(height=64, width=100)
    first = Match(disparities=40)(frame)
    others = Match(search_radius=4), Match(disparities=128, band_height=32)
    results = [first, *(match(frame, first) for match in others)]
    return hashlib.sha256(b"".join(result.pixels.tobytes() for result in results)).hexdigest()


REASONS = range(PixelOrigin.OUT_OF_VIEW, PixelOrigin.BLANK + 1)  # why a pixel is not matched


def same(one, other):
    """Whether two disparities have the same bits."""
    layers = "pixels", "source", "confidence"
    return all(getattr(one, name).tobytes() == getattr(other, name).tobytes() for name in layers)


def check_view(result, least, most, reasons=REASONS):
    """Known disparities lie within these and their partners in the right image; any other pixel has a reason alone."""
    known = np.isfinite(result.pixels)
    partner = (np.arange(known.shape[1]) - result.pixels)[known]
    assert ((partner >= 0) & (partner <= known.shape[1] - 1)).all()
    assert ((result.pixels[known] >= least) & (result.pixels[known] <= most)).all()
    assert np.array_equal(result.source == PixelOrigin.MEASURED, known)
    assert (result.confidence[~known] == 0).all()
    assert np.isin(result.source[~known], reasons).all()
    return known
