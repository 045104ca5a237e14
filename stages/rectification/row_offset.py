"""The row offset that a calibration leaves between two rectified images, measured from what both of them show.

ORB features of the fine scales are paired, Lucas-Kanade tracking places each pair to a fraction of a pixel, and a
smooth function of the place in the image is fitted to the rows by which they differ. It has the terms that a small turn
of a camera causes: pitch moves rows by 1 and y^2, roll by x, yaw by xy; a focal length that is off by y.
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
from stages.robust_weights import MAD_TO_SIGMA, tukey_weights

FEATURES = 4000  # per image
SMALLEST = 32  # px, side of an image that has any
ALIKE = 64  # largest Hamming distance of a pair, of 256 bits
DISTINCT = 0.8  # largest ratio of the distance to that of the next best (Lowe, 2004)
REACH = 48.0  # px, largest offset that is looked for
SPREAD = 6.0  # px, by how much the offset may differ from its most common value
WINDOW = 15  # px, side of the tracked patch
RETURN = 0.2  # px, how near to its start a patch tracked there and back must come
LEAST_FEATURES = 50
LEAST_ALIKE = 8  # in a frame
LEAST_SHARE = 0.5  # of the pairs, near the most common offset: else they are chance
CLEAR = 0.25  # px, largest error, anywhere in the image, of a fit that counts
DEPENDENT = 3.0  # how much larger errors are, held against exact truth, than if tracked patches erred independently
CELL = 1 / 128  # of the image's sizes: what is seen at one place in many frames errs alike, and counts once
NEGLIGIBLE = 0.1  # px, root mean square: less is not worth an interpolation; exactly aligned images measure up to 0.05
BEYOND = 1.0  # px; features of the far horizon lie about infinity
ROUNDS = 20  # of reweighting
THREADS = 2  # the frames wait for the survey, so that nothing else keeps the cores busy
MODELS = (5, 3, 1)  # terms of the models tried, richest first: all; shift, x and y; shift


@dataclass(frozen=True)
class RowOffset:
    """How many rows a point lies lower in the left image than in the right one.

    terms: weights, px, of 1, x, y, xy, y^2, where x and y are the place in the right image from its centre, in widths
    and heights; features: pairs that agree on it; error: the largest standard deviation in the image that the terms
    have by the scatter of the features, px: what a model of few terms cannot express is not in it; crossed, negative:
    the shares of features whose disparity is below that of what is infinitely far, or below 0, by more than `BEYOND`.
    """

    terms: tuple[float, ...]
    features: int
    error: float
    crossed: float = math.nan
    negative: float = math.nan

    @property
    def clear(self) -> bool:
        """Whether correcting it is worth an interpolation: more than negligible, more than its error, and possible."""
        over_the_image = self._over_the_image
        typical = float(np.sqrt(np.mean(np.square(over_the_image))))
        return typical > max(NEGLIGIBLE, self.error) and self.largest <= REACH

    @property
    def largest(self) -> float:
        """Largest magnitude in the image, px."""
        return float(np.abs(self._over_the_image).max())

    @property
    def _over_the_image(self) -> Array:
        return _grid_columns(len(self.terms)) @ np.array(self.terms)  # type: ignore[no-any-return]


def offset_at(terms: Sequence[float], x: Array, y: Array) -> Array:
    """The offset, px, at places x, y in the right image, from its centre in widths and heights (any shapes that
    broadcast)."""
    return sum((term * column for term, column in zip(terms, _basis(x, y), strict=False)), np.zeros(()))


def offset_field(terms: Sequence[float], width: int, height: int, first: int = 0) -> Array:
    """The offset at every pixel, (H, W) float32, px, from the column `first` on."""
    columns, rows = np.arange(first, first + width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
    field = offset_at(terms, *_centred(columns, rows, (height, width)))
    return np.broadcast_to(field, (height, width)).astype(np.float32)


def moved_down(image: Array, terms: tuple[float, ...]) -> Array:
    """An image (H, W) or (H, W, 3) moved down by the offset, bicubic, so that a shift by part of a row blurs least;
    0 where nothing is known."""
    moved: Array = cv2.remap(image, *_moving_maps(image.shape[1], image.shape[0], terms), cv2.INTER_CUBIC)
    return moved


@lru_cache(maxsize=4)
def _moving_maps(width: int, height: int, terms: tuple[float, ...]) -> tuple[Array, Array]:
    """Where each pixel of the moved image comes from, in cv2.remap's fixed point."""
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    maps = cv2.convertMaps(x, y - offset_field(terms, width, height), cv2.CV_16SC2)
    return maps[0], maps[1]


def measure(pairs: Sequence[tuple[Array, Array]], infinity: float = 0.0) -> RowOffset | None:
    """The row offset that all pairs of images, (H, W) uint8, left and right, have in common; None where they show none.

    infinity: the disparity of what is infinitely far, px.
    The richest model is taken that the features determine to `CLEAR` everywhere in the image. Tracking draws fractions
    of a pixel towards one half, by up to 0.03 px; so what remains after a first correction is measured once more.
    """
    with ThreadPoolExecutor(THREADS) as threads:
        seen = list(threads.map(_view, pairs))
        found = list(threads.map(lambda view: _offsets(*view), seen))
        for count in MODELS:
            first = _fit(found, count)
            if first is None or first.error > CLEAR:
                continue
            again = list(threads.map(_offsets_after, repeat(first), seen))
            rest = _fit(again, count)
            if rest is not None and rest.error <= CLEAR:
                disparity = np.concatenate([here[:, 0] - there[:, 0] for _, _, here, there in seen]) + BEYOND
                crossed, negative = (float(np.mean(disparity < limit)) for limit in (infinity, 0.0))
                terms = tuple(np.add(first.terms, rest.terms).tolist())
                return replace(rest, terms=terms, crossed=crossed, negative=negative)
    return None


def _view(pair: tuple[Array, Array]) -> tuple[Array, Array, Array, Array]:
    """Left and right image, alike in brightness, and the places (N, 2) of their features in either."""
    left, right = pair[0], _as_bright(pair[1], pair[0])
    return left, right, *_near_the_most_common(*_paired_features(left, right))


def _as_bright(image: Array, model: Array) -> Array:
    """An image scaled to the mean and the contrast of another: tracking compares brightness."""
    mean, contrast = float(image.mean()), float(image.std())
    if not contrast:
        return image
    scale = float(model.std()) / contrast
    return cv2.convertScaleAbs(image, alpha=scale, beta=float(model.mean()) - scale * mean)


def _corrected(offset: RowOffset, left: Array, right: Array, here: Array, there: Array) -> tuple[Array, ...]:
    """The view after the offset is taken away from the right image and the places of its features."""
    moved = there.copy()
    moved[:, 1] += offset_at(offset.terms, *_centred(there[:, 0], here[:, 1], right.shape))
    return left, moved_down(right, offset.terms), here, moved


def _centred(x: Array, y: Array, shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Pixels as places from the image's centre, in its width and height."""
    height, width = shape
    return (x - (width - 1) / 2) / width, (y - (height - 1) / 2) / height


def _fit(found: Sequence[tuple[Array, Array]], count: int) -> RowOffset | None:
    """The model of so many terms that fits the found offsets; None where too few agree on it."""
    if sum(len(rows) for _, rows in found) < LEAST_FEATURES:
        return None
    place, rows = (np.concatenate(parts) for parts in zip(*found, strict=True))
    terms, error, agreeing = _robust_fit(place, rows, count)
    return RowOffset(tuple(terms.tolist()), agreeing, error) if agreeing >= LEAST_FEATURES else None


def _near_the_most_common(here: Array, there: Array) -> tuple[Array, Array]:
    """The paired features (N, 2) whose row offset is near to the most common one; none where that is chance."""
    rows = here[:, 1] - there[:, 1]
    near = np.abs(rows - _most_common(rows)) <= SPREAD if len(rows) else np.zeros(0, bool)
    if np.count_nonzero(near) < max(LEAST_ALIKE, LEAST_SHARE * len(rows)):
        near[:] = False
    return here[near], there[near]


def _offsets_after(offset: RowOffset, view: tuple[Array, ...]) -> tuple[Array, Array]:
    """`_offsets` that are left after this one is taken away."""
    return _offsets(*_corrected(offset, *view))


def _offsets(left: Array, right: Array, here: Array, there: Array) -> tuple[Array, Array]:
    """Where features are in the right image (N, 2), from its centre in its sizes, and their row offsets (N,)."""
    if not len(here):
        return np.empty((0, 2)), np.empty(0)
    found, good = _tracked(left, right, here, there)
    back, well = _tracked(right, left, found, here)
    kept = good & well & (np.abs(back - here).max(axis=1) < RETURN)
    # In the corrected image the feature lies on the left image's row.
    place = np.stack(_centred(found[kept, 0], here[kept, 1], left.shape), axis=1)
    return place.astype(np.float64), (here[kept, 1] - found[kept, 1]).astype(np.float64)


def _paired_features(left: Array, right: Array) -> tuple[Array, Array]:
    """Features of both images that have a clearly best partner, (N, 2) float32 px each."""
    if min(left.shape) < SMALLEST:
        return np.empty((0, 2), np.float32), np.empty((0, 2), np.float32)
    # Coarse scales place a feature within a pixel or two only.
    detector = cv2.ORB.create(FEATURES, scaleFactor=1.5, nlevels=3, fastThreshold=5)
    (points, codes), (partners, partner_codes) = (detector.detectAndCompute(image, None) for image in (left, right))
    if len(points) < 2 or len(partners) < 2:
        return np.empty((0, 2), np.float32), np.empty((0, 2), np.float32)
    left_places, right_places = (np.array([point.pt for point in found], np.float32) for found in (points, partners))
    chosen, matched = clear_partners(codes, partner_codes, ALIKE, DISTINCT)
    here, there = left_places[chosen], right_places[matched]
    within = np.abs(here[:, 1] - there[:, 1]) <= REACH
    return here[within], there[within]


def _tracked(image: Array, other: Array, points: Array, guesses: Array) -> tuple[Array, Array]:
    """Where patches of `image` about `points` are in `other`, near `guesses`; and whether they were found."""
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.005)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        image, other, points, guesses.copy(), winSize=(WINDOW, WINDOW), maxLevel=0, criteria=stop,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return found, status[:, 0] == 1


def _most_common(values: Array) -> float:
    """The middle of the interval of 2 `SPREAD` / 3 that holds most values."""
    ordered = np.sort(values)
    last = np.searchsorted(ordered, ordered + 2 * SPREAD / 3, side="right")
    first = int(np.argmax(last - np.arange(len(ordered))))
    return float(np.median(ordered[first : last[first]]))


def _basis(x: Array, y: Array) -> tuple[Array, ...]:
    """What the terms weigh, at places from the centre in sizes of the image."""
    return np.ones_like(x), x, y, x * y, y * y


def _columns(place: Array, count: int) -> Array:
    """The first `count` of the basis at places (N, 2): (N, count)."""
    return np.stack(_basis(*place.T)[:count], axis=1)


@cache
def _grid_columns(count: int) -> Array:
    """The basis on a grid over the image, its borders included."""
    grid = np.linspace(-0.5, 0.5, 17)
    return _columns(np.stack(np.meshgrid(grid, grid), axis=2).reshape(-1, 2), count)


def _robust_fit(place: Array, values: Array, count: int) -> tuple[Array, float, int]:
    """Terms by reweighted least squares (Tukey's biweight), their largest standard deviation in the image, and how many
    values take part."""
    columns = _columns(place, count)
    weights = np.ones(len(values))
    for _ in range(ROUNDS):
        roots = np.sqrt(weights)
        terms = np.linalg.lstsq(columns * roots[:, None], values * roots, rcond=None)[0]
        residuals = values - columns @ terms
        scale = max(MAD_TO_SIGMA * float(np.median(np.abs(residuals))), 0.02)
        weights = tukey_weights(residuals, scale)
    repeated = len(place) / len(np.unique(np.floor(place / CELL), axis=0))
    covariance = np.linalg.pinv(columns.T @ (columns * weights[:, None])) * scale**2 * repeated
    grid = _grid_columns(count)
    error = DEPENDENT * float(np.sqrt(np.einsum("ij,jk,ik->i", grid, covariance, grid).max()))
    return terms, error, int(np.count_nonzero(weights))
