"""ORB features of an image: corners of several scales with binary descriptors."""

from __future__ import annotations

import cv2
import numpy as np

from stages.compiled.hamming import BYTES
from stages.data import Array

MIN_SIDE = 32  # px, of an image with features; OpenCV's detector fails on images of 1 px
FAST_THRESHOLDS = 20, 5  # gray levels; the lower one only where the higher one leaves too few features
MIN_SHARE = 0.95  # of the wanted features, for a threshold to do


def orb_features(image: Array, count: int, scale: float, levels: int) -> tuple[Array, Array]:
    """Positions (N, 2) float32, px, and descriptors (N, 32) uint8 of the strongest features, about `count` at most.

    image: (H, W) uint8; scale: size ratio of neighbouring levels of the image pyramid.
    """
    none = np.empty((0, 2), np.float32), np.empty((0, BYTES), np.uint8)
    if min(image.shape) < MIN_SIDE:
        return none
    for threshold in FAST_THRESHOLDS:
        detector = cv2.ORB.create(count, scaleFactor=scale, nlevels=levels, fastThreshold=threshold)
        found, descriptors = detector.detectAndCompute(image, None)
        if len(found) >= MIN_SHARE * count:
            break
    return (np.asarray(cv2.KeyPoint.convert(found)), descriptors) if found else none
