"""The camera's motion between two stereo frames: ORB features, PnP with RANSAC, then tracked patches.

Descriptors match over any motion, but only to a pixel or two. Their pose predicts every patch of the earlier image in
the later one, so Lucas-Kanade needs no search and is accurate to a tenth of a pixel. The pose is then fitted once more,
robustly, to the tracked patches.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stages.compiled.hamming import clear_partners
from stages.data import Array, Disparity, PixelOrigin, StereoCamera, StereoFrame
from stages.matching.intensity import gray_pair
from stages.orb import orb_features
from stages.robust_weights import tukey_weights

MIN_FEATURES = 40  # that agree on a motion
DETECTION_WIDTH = 640  # px, approximate largest width of the image in which features are detected
MAX_FEATURES = 1500
MAX_HAMMING_BITS = 64  # between the descriptors of a pair, of 256
MAX_DISTANCE_RATIO = 0.85  # to the next best partner (Lowe, 2004)
RANSAC_TOLERANCE = 3.0  # px of the detection image, reprojection error of an inlier
RANSAC_TRIALS = 300
PATCH = 11  # px, side of the tracked patch; a larger one shows surfaces at several depths
MAX_PATCH_SHIFT = 6.0  # px, from the patch's position predicted by RANSAC's pose
MIN_PATCH_SIGMA = 0.05  # px
MAX_EXPOSURE_CHANGE = 0.1  # natural logarithm of a gain between two images that tracking takes as it is
FIT_ROUNDS = 8
ERROR_INFLATION = 4.0  # measured errors over those of independent patches
MAX_DEPTH = 30.0  # m
MAX_CONDITION = 1e12  # of the normal equations


@dataclass(frozen=True, eq=False)
class VoFrame:
    """The features of a stereo frame."""

    gray: Array  # (H, W) uint8
    pixels: Array  # (N, 2) float32, px
    descriptors: Array  # (N, 32) uint8
    points: Array  # (N, 3) float64, m in the camera; NaN without a disparity
    camera: StereoCamera

    @property
    def known(self) -> int:
        """Number of features with a point."""
        return int(np.count_nonzero(np.isfinite(self.points[:, 2])))


@dataclass(frozen=True, eq=False)
class Step:
    """The camera's motion: a point p of the earlier camera is `rotation @ p + translation` in the later one."""

    rotation: Array
    translation: Array
    inliers: int  # patches that agree
    rms: float  # px, their reprojection error
    flow: float  # px, median of all patches
    covariance: Array  # (6, 6) of a small rotation (rad) and translation (m) in the later camera


def vo_frame(frame: StereoFrame, disparity: Disparity) -> VoFrame:
    """The features of the left image, with the points of those that have a disparity."""
    image = frame.once(gray_pair)[0]
    shrink = max(1, min(round(image.shape[1] / DETECTION_WIDTH), image.shape[0]))
    small = cv2.resize(image, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA) if shrink > 1 else image
    pixels, descriptors = orb_features(small, MAX_FEATURES, scale=1.3, levels=5)
    pixels = (pixels + 0.5) * shrink - 0.5
    points = _triangulated(pixels, disparity, frame.camera) if len(pixels) else np.empty((0, 3))
    return VoFrame(image, pixels, descriptors, points, frame.camera)


def _triangulated(pixels: Array, disparity: Disparity, camera: StereoCamera) -> Array:
    """Points (N, 3) of pixels (N, 2) of the left image; NaN where a neighbouring disparity is unknown or filled."""
    last = np.array(disparity.pixels.shape[::-1]) - 1
    corners = np.clip(pixels.astype(int) + np.array(list(np.ndindex(2, 2)))[:, None], 0, last)
    origins = disparity.source[corners[..., 1], corners[..., 0]]
    seen = ((origins == PixelOrigin.MEASURED) | (origins == PixelOrigin.PLANE)).all(axis=0)
    places = pixels[:, 0].copy(), pixels[:, 1].copy()
    at = cv2.remap(disparity.pixels, *places, cv2.INTER_LINEAR, borderValue=float("nan")).ravel()
    shift = np.where(seen, at.astype(np.float64), np.nan) + (camera.cx_right - camera.cx)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = camera.fx * camera.baseline / np.where(shift > 0, shift, np.nan)
    depth[~(depth <= MAX_DEPTH)] = np.nan
    x = (pixels[:, 0] - camera.cx) / camera.fx
    y = (pixels[:, 1] - camera.cy) / camera.fy
    return np.stack([x * depth, y * depth, depth], axis=1)


def step_between(earlier: VoFrame, later: VoFrame) -> Step | None:
    """The camera's motion between two frames; None if too few features agree or the image sizes differ."""
    if earlier.gray.shape != later.gray.shape:
        return None
    matrix = np.array([[later.camera.fx, 0, later.camera.cx], [0, later.camera.fy, later.camera.cy], [0, 0, 1.0]])
    here, there = _pairs(earlier, later)
    if len(here) < MIN_FEATURES:
        return None
    tolerance = RANSAC_TOLERANCE * max(1.0, later.gray.shape[1] / DETECTION_WIDTH)
    points, pixels = earlier.points[here], later.pixels[there].astype(np.float64)
    found, _, _, agreeing = cv2.solvePnPRansac(
        points, pixels, matrix, None, iterationsCount=RANSAC_TRIALS, reprojectionError=tolerance, confidence=0.9999,
        flags=cv2.SOLVEPNP_P3P,
    )  # fmt: skip
    if not found or agreeing is None or len(agreeing) < MIN_FEATURES:
        return None
    agreeing = agreeing.ravel()
    # RANSAC ends with a fit by EPnP, which is often wrong where all points lie on a plane, as on flat ground.
    found, turn, shift = cv2.solvePnP(points[agreeing], pixels[agreeing], matrix, None, flags=cv2.SOLVEPNP_SQPNP)
    if not found:
        return None
    gain = _gain(earlier, later, here[agreeing], there[agreeing])
    return _tracked_step(earlier, later, matrix, turn, shift, gain)


def _pairs(earlier: VoFrame, later: VoFrame) -> tuple[Array, Array]:
    """Indices of matching features; each earlier feature has a point."""
    known = np.flatnonzero(np.isfinite(earlier.points[:, 2]))
    here, there = clear_partners(earlier.descriptors[known], later.descriptors, MAX_HAMMING_BITS, MAX_DISTANCE_RATIO)
    return known[here], there


def _gain(earlier: VoFrame, later: VoFrame, here: Array, there: Array) -> float:
    """Brightness of the later image over that of the earlier one, the median of pairs of features."""
    before, after = (
        frame.gray[tuple(np.rint(frame.pixels[which]).astype(int).T[::-1])].astype(np.float64)
        for frame, which in ((earlier, here), (later, there))
    )
    return float(np.median((after + 1) / (before + 1)))


def _tracked_step(
    earlier: VoFrame, later: VoFrame, matrix: Array, turn: Array, shift: Array, gain: float
) -> Step | None:
    """The pose fitted to patches of the earlier image, tracked from their positions predicted by the given pose.

    gain: brightness of the later image over that of the earlier one.
    """
    points, start, guess = _predicted(earlier, later, matrix, turn, shift)
    if len(points) < MIN_FEATURES:
        return None
    image = later.gray
    if abs(np.log(gain)) > MAX_EXPOSURE_CHANGE:  # tracking compares brightness
        image = cv2.LUT(image, np.clip(np.rint(np.arange(256) / gain), 0, 255).astype(np.uint8))
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.02)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        earlier.gray, image, start, guess.copy(), winSize=(PATCH, PATCH), maxLevel=0, criteria=stop,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    good = (status[:, 0] == 1) & (np.linalg.norm(found - guess, axis=1) < MAX_PATCH_SHIFT)
    if np.count_nonzero(good) < MIN_FEATURES:
        return None
    return _fitted(points[good], start[good], found[good].astype(np.float64), matrix, turn, shift)


def _predicted(
    earlier: VoFrame, later: VoFrame, matrix: Array, turn: Array, shift: Array
) -> tuple[Array, Array, Array]:
    """Points of the earlier frame in view of the later one, with their pixels in both."""
    known = np.isfinite(earlier.points[:, 2])
    points, pixels = earlier.points[known], earlier.pixels[known]
    depth = (points @ cv2.Rodrigues(turn)[0].T + shift.ravel())[:, 2]
    points, pixels = points[depth > 0.1], pixels[depth > 0.1]
    if not len(points):
        return points, pixels, pixels
    at = cv2.projectPoints(points, turn, shift, matrix, None)[0].reshape(-1, 2)
    height, width = later.gray.shape
    inside = np.all((at > PATCH / 2) & (at < np.array([width, height]) - PATCH / 2), axis=1)
    return points[inside], pixels[inside], at[inside].astype(np.float32)


def _fitted(points: Array, start: Array, found: Array, matrix: Array, turn: Array, shift: Array) -> Step | None:
    """The pose that fits points (N, 3) to their pixels (N, 2), by Gauss-Newton with Tukey's weights."""
    pose = np.concatenate([turn.ravel(), shift.ravel()])
    for _ in range(FIT_ROUNDS):
        at, jacobian = cv2.projectPoints(points, pose[:3], pose[3:], matrix, None)
        errors = (found - at.reshape(-1, 2)).ravel()
        jacobian = jacobian[:, :6]
        sizes = np.linalg.norm(errors.reshape(-1, 2), axis=1)
        scale = max(float(np.median(sizes)) / 1.1774, MIN_PATCH_SIGMA)  # median of a Rayleigh distribution
        weights = tukey_weights(sizes, scale)
        both = np.repeat(weights, 2)
        normal = jacobian.T @ (jacobian * both[:, None])
        if not np.all(np.isfinite(normal)) or np.linalg.cond(normal) > MAX_CONDITION:
            return None
        pose = pose + np.linalg.solve(normal, jacobian.T @ (errors * both))
    inside = weights > 0
    if np.count_nonzero(inside) < MIN_FEATURES:
        return None
    # The Jacobian is with respect to the rotation vector, close enough to a small rotation for a few degrees.
    covariance = np.linalg.inv(normal) * (ERROR_INFLATION * scale) ** 2
    return Step(
        cv2.Rodrigues(pose[:3])[0], pose[3:], int(np.count_nonzero(inside)),
        float(np.sqrt(np.mean(np.square(sizes[inside])))),
        float(np.median(np.linalg.norm(found - start, axis=1))), covariance,
    )  # fmt: skip
