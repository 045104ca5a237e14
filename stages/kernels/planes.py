"""A plane per superpixel (section 3.2 of the paper) by MSAC (Torr & Zisserman, 2000) and two least-squares refits.

The pixels of each segment are gathered once through a compressed row list, so every hypothesis is scored over
contiguous float32. Each segment draws from its own counter-based random numbers (splitmix64 of seed and segment): the
result depends neither on the other segments nor on the order in which they are fitted.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from stages.data import Array

F32 = np.float32
U64 = np.uint64
LEAST_SUPPORT = 6  # twice the parameters of a plane: below that, agreement says nothing
LEAST_TRIANGLE = 4.0  # twice the area, px^2, of the triangle of a hypothesis: below that, slopes are noise


class Planes(NamedTuple):
    """Planes d = a x + b y + c of n segments, pixel coordinates of the whole image.

    coefficients: (n, 3) float64 a, b, c, NaN where no plane was found; inlier_share: (n,) float32, inliers among the
    known pixels; valid_share: (n,) float32, known pixels among all.
    """

    coefficients: Array
    inlier_share: Array
    valid_share: Array


def fit_planes(
    disparity: Array, labels: Array, count: int, threshold: float = 0.5, hypotheses: int = 64, seed: int = 0
) -> Planes:
    """Fit one plane to the known disparities of each segment.

    disparity: (H, W) float32, px, NaN = unknown; labels: (H, W) int32 in 0..count-1; threshold: px, beyond which a
    pixel is an outlier. The same seed gives the same planes.
    """
    start, index = segment_pixels(labels, count)
    planes = Planes(np.empty((count, 3)), np.empty(count, np.float32), np.empty(count, np.float32))
    largest = int(np.diff(start).max(initial=0))
    points = np.empty((3, max(largest, 1)), np.float32)
    mixed = U64(seed % 2**64)
    _fit(disparity, start, index, F32(threshold), hypotheses, mixed, points, *planes)
    return planes


def segment_pixels(labels: Array, count: int) -> tuple[Array, Array]:
    """The pixels of each segment: those of segment s are index[start[s]:start[s + 1]], in scan order.

    labels: (H, W) int32 in 0..count-1. Returns start (count + 1,) int64 and index (H * W,) int32.
    """
    start = np.zeros(count + 1, np.int64)
    index = np.empty(labels.size, np.int32)
    _segment_pixels(labels.ravel(), start, index)
    return start, index


def render_planes(coefficients: Array, labels: Array) -> Array:
    """The disparity image (H, W) float32 that the planes describe; NaN in segments without one."""
    image = np.empty(labels.shape, np.float32)
    _render(coefficients, labels, image)
    return image


@njit(nogil=True, cache=True)
def _segment_pixels(labels, start, index):  # type: ignore[no-untyped-def]
    for i in range(labels.size):
        start[labels[i] + 1] += 1
    for s in range(start.size - 1):
        start[s + 1] += start[s]
    fill = start[:-1].copy()
    for i in range(labels.size):
        index[fill[labels[i]]] = i
        fill[labels[i]] += 1


@njit(nogil=True, cache=True)
def _render(coefficients, labels, image):  # type: ignore[no-untyped-def]
    for y in range(labels.shape[0]):
        for x in range(labels.shape[1]):
            s = labels[y, x]
            image[y, x] = coefficients[s, 0] * x + coefficients[s, 1] * y + coefficients[s, 2]


@njit(nogil=True, cache=True, inline="always")
def _draw(seed, segment, counter, n):  # type: ignore[no-untyped-def]
    """A number below n: splitmix64 of (seed, segment, counter)."""
    z = seed + U64(segment) * U64(0xD1B54A32D192ED03) + U64(counter) * U64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> U64(30))) * U64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> U64(27))) * U64(0x94D049BB133111EB)
    return np.int64((z ^ (z >> U64(31))) >> U64(33)) % n


@njit(nogil=True, cache=True, error_model="numpy")
def _fit(disparity, start, index, threshold, hypotheses, seed, points, coefficients, inlier_share, valid_share):  # type: ignore[no-untyped-def]
    width = disparity.shape[1]
    flat = disparity.ravel()
    for s in range(start.size - 1):
        total = start[s + 1] - start[s]
        coefficients[s, :] = np.nan
        inlier_share[s] = valid_share[s] = F32(0)
        if total == 0:
            continue
        # Coordinates from the segment's first pixel keep float32 sums exact enough.
        origin_y, origin_x = index[start[s]] // width, index[start[s]] % width
        n = 0
        for j in range(start[s], start[s + 1]):
            d = flat[index[j]]
            if d == d:
                points[0, n] = index[j] % width - origin_x
                points[1, n] = index[j] // width - origin_y
                points[2, n] = d
                n += 1
        valid_share[s] = F32(n / total)
        if n < LEAST_SUPPORT:
            continue
        x, y, d = points[0, :n], points[1, :n], points[2, :n]
        cost, a, b, c = _best_hypothesis(x, y, d, threshold * threshold, hypotheses, seed, s)
        if cost >= F32(1e30):
            continue
        for _ in range(2):
            a, b, c = _least_squares(x, y, d, a, b, c, threshold * threshold)
        inlier_share[s] = F32(_count_inliers(x, y, d, a, b, c, threshold * threshold) / n)
        coefficients[s, 0], coefficients[s, 1] = a, b
        coefficients[s, 2] = np.float64(c) - np.float64(a) * origin_x - np.float64(b) * origin_y


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _best_hypothesis(x, y, d, limit, hypotheses, seed, segment):  # type: ignore[no-untyped-def]
    """The plane through three drawn pixels with the least truncated squared error: (cost, a, b, c)."""
    n = x.size
    best, best_a, best_b, best_c = F32(1e30), F32(0), F32(0), F32(0)
    for h in range(hypotheses):
        i = _draw(seed, segment, 3 * h, n)
        j = _draw(seed, segment, 3 * h + 1, n)
        k = _draw(seed, segment, 3 * h + 2, n)
        x1, y1, d1 = x[j] - x[i], y[j] - y[i], d[j] - d[i]
        x2, y2, d2 = x[k] - x[i], y[k] - y[i], d[k] - d[i]
        area = x1 * y2 - x2 * y1
        if abs(area) < F32(LEAST_TRIANGLE):
            continue
        a, b = (d1 * y2 - d2 * y1) / area, (x1 * d2 - x2 * d1) / area
        c = d[i] - a * x[i] - b * y[i]
        cost = F32(0)
        for q in range(n):
            e = a * x[q] + b * y[q] + c - d[q]
            cost += min(e * e, limit)
        if cost < best:
            best, best_a, best_b, best_c = cost, a, b, c
    return best, best_a, best_b, best_c


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _least_squares(x, y, d, a, b, c, limit):  # type: ignore[no-untyped-def]
    """The least-squares plane of the inliers of (a, b, c), solved for the correction, about the inliers' centroid."""
    s = sx = sy = se = F32(0)
    for q in range(x.size):
        e = d[q] - a * x[q] - b * y[q] - c
        w = F32(1) if e * e < limit else F32(0)
        s += w
        sx += w * x[q]
        sy += w * y[q]
        se += w * e
    if s < F32(LEAST_SUPPORT):
        return a, b, c
    mx, my, me = sx / s, sy / s, se / s
    xx = xy = yy = xe = ye = F32(0)
    for q in range(x.size):
        e = d[q] - a * x[q] - b * y[q] - c
        w = F32(1) if e * e < limit else F32(0)
        u, v, r = x[q] - mx, y[q] - my, e - me
        xx += w * u * u
        xy += w * u * v
        yy += w * v * v
        xe += w * u * r
        ye += w * v * r
    determinant = xx * yy - xy * xy
    if determinant < F32(1e-3) * s * s:  # inliers on a line: the slope across it is unknown, keep the hypothesis
        return a, b, c
    da, db = (xe * yy - ye * xy) / determinant, (xx * ye - xy * xe) / determinant
    return a + da, b + db, c + me - da * mx - db * my


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _count_inliers(x, y, d, a, b, c, limit):  # type: ignore[no-untyped-def]
    inliers = 0
    for q in range(x.size):
        e = a * x[q] + b * y[q] + c - d[q]
        inliers += 1 if e * e < limit else 0
    return inliers


def fit_planes_reference(
    disparity: Array, labels: Array, count: int, threshold: float = 0.5, hypotheses: int = 64, seed: int = 0
) -> Planes:
    """`fit_planes` in plain numpy and float64, one segment after the other, drawing the same hypotheses."""
    planes = Planes(np.full((count, 3), np.nan), np.zeros(count, np.float32), np.zeros(count, np.float32))
    for s in range(count):
        y, x = np.nonzero(labels == s)
        known = np.isfinite(disparity[y, x])
        planes.valid_share[s] = known.mean() if known.size else 0
        if known.sum() < LEAST_SUPPORT:
            continue
        points = np.stack([x[known], y[known], np.ones(known.sum())], axis=1).astype(np.float64)
        d = disparity[y, x][known].astype(np.float64)
        best, plane = np.inf, None
        for h in range(hypotheses):
            corners = [_draw_reference(seed, s, 3 * h + i, len(d)) for i in range(3)]
            if abs(np.linalg.det(points[corners])) < LEAST_TRIANGLE:
                continue
            candidate = np.linalg.solve(points[corners], d[corners])
            cost = np.minimum((points @ candidate - d) ** 2, threshold**2).sum()
            if cost < best:
                best, plane = cost, candidate
        if plane is None:
            continue
        for _ in range(2):
            inlier = (points @ plane - d) ** 2 < threshold**2
            if inlier.sum() >= LEAST_SUPPORT:
                plane = np.linalg.lstsq(points[inlier], d[inlier], rcond=None)[0]
        planes.coefficients[s] = plane
        planes.inlier_share[s] = ((points @ plane - d) ** 2 < threshold**2).mean()
    return planes


def _draw_reference(seed: int, segment: int, counter: int, n: int) -> int:
    mask = 2**64 - 1
    z = (seed + segment * 0xD1B54A32D192ED03 + counter * 0x9E3779B97F4A7C15) & mask
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & mask
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & mask
    return ((z ^ (z >> 31)) >> 33) % n
