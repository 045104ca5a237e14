"""How the camera moved between two stereo frames: ORB features, PnP with RANSAC, then tracked patches.

The trick is the order. Descriptors find their partners over any motion, but place them to a pixel or two only; the pose
they give says where every patch of the earlier image must be in the later one, so that Lucas-Kanade needs no search
and places it to a tenth of a pixel. The pose is then fitted once more, robustly, to those places.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stages.compiled.hamming import clear_partners
from stages.data import Array, Disparity, PixelOrigin, StereoCamera, StereoFrame
from stages.matching.intensity import eight_bit, gray
from stages.robust_weights import tukey_weights

DETECTION_WIDTH = 640  # px; features are looked for in an image of at most about this width
FEATURES = 1500
ALIKE = 64  # largest Hamming distance of a pair, of 256 bits
DISTINCT = 0.85  # largest ratio of the distance to that of the next best (Lowe, 2004)
COARSE = 3.0  # px of the detection image, reprojection error of an inlier of RANSAC
TRIALS = 300
PATCH = 21  # px, side of the tracked patch
STRAY = 6.0  # px, by how much a patch may lie beside the place that RANSAC's pose gives it
SHARPEST = 0.05  # px, least standard deviation that tracked patches are taken to have
ROUNDS = 8
DEPENDENT = 4.0  # how much larger errors are, held against exact truth, than if patches erred independently
DEEPEST = 30.0  # m


@dataclass(frozen=True, eq=False)
class VoFrame:
    """What is kept of a stereo frame to track from and to.

    gray: (H, W) uint8; places: (N, 2) float32 px of its features, codes: (N, 32) uint8 their descriptors; points:
    (N, 3) float64 m in the camera, NaN where the disparity is not known.
    """

    gray: Array
    places: Array
    codes: Array
    points: Array
    camera: StereoCamera

    @property
    def known(self) -> int:
        """How many features have a place in space."""
        return int(np.count_nonzero(np.isfinite(self.points[:, 2])))


@dataclass(frozen=True, eq=False)
class Step:
    """How the camera moved: a point p of the earlier camera is at `rotation @ p + translation` in the later one's.

    inliers: patches that agree; error: their root mean square reprojection error, px; flow: their median way, px;
    covariance: (6, 6) of a small turn (rad) and shift (m) in the later camera's frame.
    """

    rotation: Array
    translation: Array
    inliers: int
    error: float
    flow: float
    covariance: Array


def view(frame: StereoFrame, disparity: Disparity) -> VoFrame:
    """The features of the left image, and where in space those are whose disparity is measured."""
    image = gray(eight_bit(frame.left)[0])
    shrink = max(1, round(image.shape[1] / DETECTION_WIDTH))
    small = cv2.resize(image, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA) if shrink > 1 else image
    nothing = VoFrame(image, np.empty((0, 2), np.float32), np.empty((0, 32), np.uint8), np.empty((0, 3)), frame.camera)
    if min(small.shape) < PATCH:  # OpenCV fails on the smallest
        return nothing
    found, codes = cv2.ORB.create(FEATURES, scaleFactor=1.3, nlevels=5, fastThreshold=5).detectAndCompute(small, None)
    if not found:
        return nothing
    places = (np.array([point.pt for point in found], np.float32) + 0.5) * shrink - 0.5
    return VoFrame(image, places, codes, _in_space(places, disparity, frame.camera), frame.camera)


def _in_space(places: Array, disparity: Disparity, camera: StereoCamera) -> Array:
    """Places (N, 2) of the left image as points (N, 3); NaN where a disparity about them is unknown or filled."""
    seen = np.isin(disparity.source, (PixelOrigin.MEASURED, PixelOrigin.PLANE))
    pixels = np.where(seen, disparity.pixels, np.float32(np.nan))
    at = cv2.remap(pixels, places[:, 0].copy(), places[:, 1].copy(), cv2.INTER_LINEAR, borderValue=float("nan"))
    shift = at.ravel().astype(np.float64) + (camera.cx_right - camera.cx)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = camera.fx * camera.baseline / np.where(shift > 0, shift, np.nan)
    depth[~(depth <= DEEPEST)] = np.nan
    x = (places[:, 0] - camera.cx) / camera.fx
    y = (places[:, 1] - camera.cy) / camera.fy
    return np.stack([x * depth, y * depth, depth], axis=1)


def step_between(earlier: VoFrame, later: VoFrame, least: int) -> Step | None:
    """How the camera moved from one view to another; None where fewer than `least` features agree on it, or where the
    images are not of one size: a patch looks different then."""
    if earlier.gray.shape != later.gray.shape:
        return None
    matrix = np.array([[later.camera.fx, 0, later.camera.cx], [0, later.camera.fy, later.camera.cy], [0, 0, 1.0]])
    here, there = _pairs(earlier, later)
    if len(here) < least:
        return None
    tolerance = COARSE * max(1.0, later.gray.shape[1] / DETECTION_WIDTH)
    found, turn, shift, agreeing = cv2.solvePnPRansac(
        earlier.points[here], later.places[there].astype(np.float64), matrix, None, iterationsCount=TRIALS,
        reprojectionError=tolerance, confidence=0.9999, flags=cv2.SOLVEPNP_P3P,
    )  # fmt: skip
    if not found or agreeing is None or len(agreeing) < least:
        return None
    return _tracked_step(earlier, later, matrix, turn, shift, least)


def _pairs(earlier: VoFrame, later: VoFrame) -> tuple[Array, Array]:
    """Indices of features, those of the earlier view known in space, that have a clearly best partner."""
    known = np.flatnonzero(np.isfinite(earlier.points[:, 2]))
    here, there = clear_partners(earlier.codes[known], later.codes, ALIKE, DISTINCT)
    return known[here], there


def _tracked_step(
    earlier: VoFrame, later: VoFrame, matrix: Array, turn: Array, shift: Array, least: int
) -> Step | None:
    """The pose fitted to patches of the earlier image, tracked from where the given pose puts them."""
    points, start, guess = _ahead(earlier, later, matrix, turn, shift)
    if len(points) < least:
        return None
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        earlier.gray, later.gray, start, guess.copy(), winSize=(PATCH, PATCH), maxLevel=1, criteria=stop,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    good = (status[:, 0] == 1) & (np.linalg.norm(found - guess, axis=1) < STRAY)
    if np.count_nonzero(good) < least:
        return None
    return _fitted(points[good], start[good], found[good].astype(np.float64), matrix, turn, shift, least)


def _ahead(earlier: VoFrame, later: VoFrame, matrix: Array, turn: Array, shift: Array) -> tuple[Array, Array, Array]:
    """The earlier view's points that the later image shows, and where the earlier and the later image show them."""
    known = np.isfinite(earlier.points[:, 2])
    points, places = earlier.points[known], earlier.places[known]
    depth = (points @ cv2.Rodrigues(turn)[0].T + shift.ravel())[:, 2]
    points, places = points[depth > 0.1], places[depth > 0.1]
    if not len(points):
        return points, places, places
    at = cv2.projectPoints(points, turn, shift, matrix, None)[0].reshape(-1, 2)
    height, width = later.gray.shape
    inside = np.all((at > PATCH / 2) & (at < np.array([width, height]) - PATCH / 2), axis=1)
    return points[inside], places[inside], at[inside].astype(np.float32)


def _fitted(
    points: Array, start: Array, found: Array, matrix: Array, turn: Array, shift: Array, least: int
) -> Step | None:
    """The pose that fits points (N, 3) to their places (N, 2), by Gauss-Newton with Tukey's weights."""
    pose = np.concatenate([turn.ravel(), shift.ravel()])
    for _ in range(ROUNDS):
        at, slopes = cv2.projectPoints(points, pose[:3], pose[3:], matrix, None)
        errors = (found - at.reshape(-1, 2)).ravel()
        slopes = slopes[:, :6]
        sizes = np.linalg.norm(errors.reshape(-1, 2), axis=1)
        scale = max(float(np.median(sizes)) / 1.1774, SHARPEST)  # the median of a Rayleigh distribution
        weights = tukey_weights(sizes, scale)
        both = np.repeat(weights, 2)
        normal = slopes.T @ (slopes * both[:, None])
        if not np.all(np.isfinite(normal)) or np.linalg.cond(normal) > 1e12:
            return None
        pose = pose + np.linalg.solve(normal, slopes.T @ (errors * both))
    inside = weights > 0
    if np.count_nonzero(inside) < least:
        return None
    # The slopes are those of the rotation vector; near enough those of a small turn for turns of some degrees.
    covariance = np.linalg.inv(normal) * (DEPENDENT * scale) ** 2
    return Step(
        cv2.Rodrigues(pose[:3])[0], pose[3:], int(np.count_nonzero(inside)),
        float(np.sqrt(np.mean(np.square(sizes[inside])))),
        float(np.median(np.linalg.norm(found - start, axis=1))), covariance,
    )  # fmt: skip
