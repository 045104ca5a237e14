"""The row offset that a calibration leaves between two rectified images, measured on features of both.

ORB features of the fine scales are paired, and Lucas-Kanade tracking refines each pair to a fraction of a pixel. A
smooth function of the image position is fitted to their row differences. Its terms are those of a small rotation of a
camera: pitch moves rows by 1 and y^2, roll by x, yaw by xy; an error of the focal length moves them by y.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from itertools import repeat

import cv2
import numpy as np

from stages.compiled.hamming import clear_partners
from stages.data import Array
from stages.orb import orb_features
from stages.robust_weights import MAD_TO_SIGMA, tukey_weights

MAX_ORB_FEATURES = 4000  # per image
MAX_HAMMING_BITS = 64  # largest Hamming distance of a pair, of 256 bits
MAX_DISTANCE_RATIO = 0.8  # largest ratio of the distance to that of the next best (Lowe, 2004)
MAX_OFFSET = 48.0  # px, largest offset that is searched
MODE_WIDTH = 6.0  # px, largest difference from the most common offset
TRACKING_WINDOW = 15  # px, side of the tracked patch
MAX_RETURN_ERROR = 0.2  # px, largest error of a patch tracked there and back
MIN_FEATURES = 50
MIN_FRAME_FEATURES = 8  # in a frame
MIN_MODE_SHARE = 0.5  # of the pairs, near the most common offset; fewer are chance
MAX_FIT_ERROR = 0.25  # px, largest error anywhere in the image of a fit that is used
ERROR_SCALE = 3.0  # ratio of true errors to those of independent patches, measured against exact truth
CLUSTER_SIZE = 1 / 128  # of the image's sizes: features at one position in many frames err together, and count once
MIN_RMS_OFFSET = 0.1  # px; less is not worth an interpolation; exactly aligned images measure up to 0.05
INFINITY_TOLERANCE = 1.0  # px; features of the far horizon scatter around infinity
REWEIGHTINGS = 20
THREADS = 2  # the frames wait for the survey, so the cores are free
MODELS = (5, 3, 1)  # terms of the models tried, richest first: all; shift, x and y; shift


@dataclass(frozen=True)
class RowOffset:
    """The rows by which a point lies lower in the left image than in the right one.

    Attributes
    ----------
    terms
        Weights, px, of 1, x, y, xy, y^2; x and y are the position in the right image from its centre, in widths and
        heights.
    features
        The number of pairs that agree.
    error
        Largest standard deviation of the offset in the image, px, by the scatter of the features. Errors of the model
        itself are not included.
    crossed, negative
        Shares of features whose disparity is below that of infinity, or below 0, by over `INFINITY_TOLERANCE`.
    """

    terms: tuple[float, ...]
    features: int
    error: float
    crossed: float = math.nan
    negative: float = math.nan

    @property
    def clear(self) -> bool:
        """Whether a correction is worth an interpolation: the offset exceeds noise and its error, and is in range."""
        over_the_image = self._over_the_image
        typical = float(np.sqrt(np.mean(np.square(over_the_image))))
        return typical > max(MIN_RMS_OFFSET, self.error) and self.largest <= MAX_OFFSET

    @property
    def largest(self) -> float:
        """Largest magnitude in the image, px."""
        return float(np.abs(self._over_the_image).max())

    @property
    def _over_the_image(self) -> Array:
        return _grid_columns(len(self.terms)) @ np.array(self.terms)  # type: ignore[no-any-return]


def offset_at(terms: Sequence[float], x: Array, y: Array) -> Array:
    """The offset, px, at positions x, y in the right image, from its centre in widths and heights (broadcast)."""
    return sum((term * column for term, column in zip(terms, _basis(x, y), strict=False)), np.zeros(()))


def offset_field(terms: Sequence[float], width: int, height: int, first: int = 0) -> Array:
    """The offset at every pixel, (H, W) float32, px, from the column `first` on."""
    columns, rows = np.arange(first, first + width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
    field = offset_at(terms, *_centred(columns, rows, (height, width)))
    return np.broadcast_to(field, (height, width)).astype(np.float32)


def moved_down(image: Array, terms: tuple[float, ...]) -> Array:
    """An image (H, W) or (H, W, 3) moved down by the offset, by bicubic interpolation; 0 outside the image."""
    moved: Array = cv2.remap(image, *_moving_maps(image.shape[1], image.shape[0], terms), cv2.INTER_CUBIC)
    return moved


@lru_cache(maxsize=4)
def _moving_maps(width: int, height: int, terms: tuple[float, ...]) -> tuple[Array, Array]:
    """The source position of each pixel of the moved image, in cv2.remap's fixed point."""
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    maps = cv2.convertMaps(x, y - offset_field(terms, width, height), cv2.CV_16SC2)
    return maps[0], maps[1]


def measure(pairs: Sequence[tuple[Array, Array]], infinity: float = 0.0) -> RowOffset | None:
    """The common row offset of all pairs of images, (H, W) uint8, left and right; None if it is not clear.

    infinity: the disparity of infinitely far points, px.
    The richest model with an error of at most `MAX_FIT_ERROR` everywhere in the image is used. Tracking pulls fractions
    of a pixel towards one half, by up to 0.03 px, so the rest after a first correction is measured again.
    """
    with ThreadPoolExecutor(THREADS) as threads:
        seen = list(threads.map(_view, pairs))
        found = list(threads.map(lambda view: _offsets(*view), seen))
        for count in MODELS:
            first = _fit(found, count)
            if first is None or first.error > MAX_FIT_ERROR:
                continue
            again = list(threads.map(_offsets_after, repeat(first), seen))
            rest = _fit(again, count)
            if rest is not None and rest.error <= MAX_FIT_ERROR:
                disparity = (
                    np.concatenate([here[:, 0] - there[:, 0] for _, _, here, there in seen]) + INFINITY_TOLERANCE
                )
                crossed, negative = (float(np.mean(disparity < limit)) for limit in (infinity, 0.0))
                terms = tuple(np.add(first.terms, rest.terms).tolist())
                return replace(rest, terms=terms, crossed=crossed, negative=negative)
    return None


def _view(pair: tuple[Array, Array]) -> tuple[Array, Array, Array, Array]:
    """Left and right image, equal in brightness, and the positions (N, 2) of their features in each."""
    left, right = pair[0], _as_bright(pair[1], pair[0])
    return left, right, *_near_the_most_common(*_paired_features(left, right))


def _as_bright(image: Array, model: Array) -> Array:
    """An image scaled to the mean and the contrast of another, because tracking compares brightness."""
    (mean, contrast), (other_mean, other_contrast) = (np.ravel(cv2.meanStdDev(of)).tolist() for of in (image, model))
    if not contrast:
        return image
    scale = other_contrast / contrast
    levels = np.clip(np.rint(scale * (np.arange(256) - mean) + other_mean), 0, 255)
    return cv2.LUT(image, levels.astype(np.uint8))


def _centred(x: Array, y: Array, shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Pixels as positions from the image's centre, in its width and height."""
    height, width = shape
    return (x - (width - 1) / 2) / width, (y - (height - 1) / 2) / height


def _fit(found: Sequence[tuple[Array, Array]], count: int) -> RowOffset | None:
    """The model of `count` terms that fits the offsets; None if too few agree."""
    if sum(len(rows) for _, rows in found) < MIN_FEATURES:
        return None
    place, rows = (np.concatenate(parts) for parts in zip(*found, strict=True))
    terms, error, agreeing = _robust_fit(place, rows, count)
    return RowOffset(tuple(terms.tolist()), agreeing, error) if agreeing >= MIN_FEATURES else None


def _near_the_most_common(here: Array, there: Array) -> tuple[Array, Array]:
    """The paired features (N, 2) with a row offset near the most common one; none if that may be chance."""
    rows = here[:, 1] - there[:, 1]
    near = np.abs(rows - _most_common(rows)) <= MODE_WIDTH if len(rows) else np.zeros(0, bool)
    if np.count_nonzero(near) < max(MIN_FRAME_FEATURES, MIN_MODE_SHARE * len(rows)):
        near[:] = False
    return here[near], there[near]


def _offsets_after(offset: RowOffset, view: tuple[Array, ...]) -> tuple[Array, Array]:
    """The `_offsets` that remain once the right image of a view and its features are moved down by an offset."""
    left, right, here, there = view
    moved = there.copy()
    moved[:, 1] += offset_at(offset.terms, *_centred(there[:, 0], here[:, 1], right.shape))
    return _offsets(left, moved_down(right, offset.terms), here, moved)


def _offsets(left: Array, right: Array, here: Array, there: Array) -> tuple[Array, Array]:
    """Positions of features in the right image (N, 2), from its centre in its sizes, and row offsets (N,)."""
    if not len(here):
        return np.empty((0, 2)), np.empty(0)
    found, good = _tracked(left, right, here, there)
    back, well = _tracked(right, left, found, here)
    kept = good & well & (np.abs(back - here).max(axis=1) < MAX_RETURN_ERROR)
    # In the corrected image the feature lies on the left image's row.
    place = np.stack(_centred(found[kept, 0], here[kept, 1], left.shape), axis=1)
    return place.astype(np.float64), (here[kept, 1] - found[kept, 1]).astype(np.float64)


def _paired_features(left: Array, right: Array) -> tuple[Array, Array]:
    """Features of both images with an unambiguous partner, (N, 2) float32 px each."""
    # Coarse scales place a feature within a pixel or two.
    (places, codes), (partners, partner_codes) = (
        orb_features(image, MAX_ORB_FEATURES, scale=1.5, levels=3) for image in (left, right)
    )
    chosen, matched = clear_partners(codes, partner_codes, MAX_HAMMING_BITS, MAX_DISTANCE_RATIO)
    here, there = places[chosen], partners[matched]
    within = np.abs(here[:, 1] - there[:, 1]) <= MAX_OFFSET
    return here[within], there[within]


def _tracked(image: Array, other: Array, points: Array, guesses: Array) -> tuple[Array, Array]:
    """Positions in `other` of the patches at `points` of `image`, near `guesses`; and whether they were found."""
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.005)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        image, other, points, guesses.copy(), winSize=(TRACKING_WINDOW, TRACKING_WINDOW), maxLevel=0, criteria=stop,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return found, status[:, 0] == 1


def _most_common(values: Array) -> float:
    """The middle of the interval of 2 `MODE_WIDTH` / 3 that holds most values."""
    ordered = np.sort(values)
    last = np.searchsorted(ordered, ordered + 2 * MODE_WIDTH / 3, side="right")
    first = int(np.argmax(last - np.arange(len(ordered))))
    return float(np.median(ordered[first : last[first]]))


def _basis(x: Array, y: Array) -> tuple[Array, ...]:
    """The functions weighted by the terms, at positions from the centre in sizes of the image."""
    return np.ones_like(x), x, y, x * y, y * y


def _columns(place: Array, count: int) -> Array:
    """The first `count` functions of the basis at positions (N, 2): (N, count)."""
    return np.stack(_basis(*place.T)[:count], axis=1)


@cache
def _grid_columns(count: int) -> Array:
    """The basis on a grid over the image, its borders included."""
    grid = np.linspace(-0.5, 0.5, 17)
    return _columns(np.stack(np.meshgrid(grid, grid), axis=2).reshape(-1, 2), count)


def _robust_fit(place: Array, values: Array, count: int) -> tuple[Array, float, int]:
    """Terms by reweighted least squares (Tukey's biweight), their largest standard deviation in the image, inliers."""
    columns = _columns(place, count)
    weights = np.ones(len(values))
    for _ in range(REWEIGHTINGS):
        weighted = columns * weights[:, None]
        terms = np.linalg.pinv(weighted.T @ columns) @ (weighted.T @ values)
        residuals = values - columns @ terms
        scale = max(MAD_TO_SIGMA * float(np.median(np.abs(residuals))), 0.02)
        weights = tukey_weights(residuals, scale)
    repeated = len(place) / len(np.unique(np.floor(place / CLUSTER_SIZE), axis=0))
    covariance = np.linalg.pinv(columns.T @ (columns * weights[:, None])) * scale**2 * repeated
    grid = _grid_columns(count)
    error = ERROR_SCALE * float(np.sqrt(np.einsum("ij,jk,ik->i", grid, covariance, grid).max()))
    return terms, error, int(np.count_nonzero(weights))
