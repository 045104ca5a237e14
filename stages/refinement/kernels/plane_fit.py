"""One plane per region (section 3.2 of the paper) by MSAC (Torr & Zisserman, 2000) and two weighted refits.

The known pixels are gathered region by region once, so that every hypothesis is scored over contiguous float32. Each
region has its own counter-based random numbers (splitmix64 of seed and region): the result depends neither on other
regions nor on their order.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stages.compiled.jit import fast_part, kernel, part
from stages.compiled.parallel import by_bands, shared_by
from stages.data import Array

F32 = np.float32
U64 = np.uint64
MIN_POINTS = 6  # matches; twice the parameters of a plane, so that agreement is no coincidence
INLIER_DISTANCE = 0.5  # px, from a plane
MIN_TRIANGLE = 4.0  # px^2, twice the area of a hypothesis's triangle; slopes of smaller ones are noise


class Planes(NamedTuple):
    """Planes d = a x + b y + c of n regions, in pixel coordinates of the whole image.

    coefficients: (n, 3) float64 a, b, c, NaN = no plane; inlier_share: (n,) float32, inliers among the known pixels;
    valid_share: (n,) float32, known pixels among all.
    """

    coefficients: Array
    inlier_share: Array
    valid_share: Array


def fit_planes(
    disparity: Array, labels: Array, count: int, weights: Array, hypotheses: int, seed: int = 0, threads: int = 1
) -> Planes:
    """Fit one plane to the known disparities of each region.

    disparity: (H, W) float32, px, NaN = unknown; labels: (H, W) int32 in 0..count-1; weights: (H, W) float32 > 0, of
    the least squares; hypotheses: planes tried per region. The same seed gives the same planes, with any number of
    threads.
    """
    assert weights.shape == labels.shape, "a weight for each pixel"
    planes = Planes(np.empty((count, 3)), np.empty(count, np.float32), np.empty(count, np.float32))
    points, start, sizes = known_points(disparity, labels, count, weights)
    given = points, start, sizes, hypotheses, U64(seed % 2**64)
    by_bands(shared_by(threads), count, lambda first, end: _fit(*given, first, end, *planes))
    return planes


def known_points(disparity: Array, labels: Array, count: int, weights: Array) -> tuple[Array, Array, Array]:
    """The known pixels, region by region, each in scan order.

    Parameters as in `fit_planes`. Returns (4, n) float32: column, row, disparity and weight; (count + 1,) int64: region
    s has the points start[s] to start[s + 1]; and (count,) int64: the size of each region, with its unknown pixels.
    """
    known, sizes = np.zeros((2, count), np.int64)
    _count_points(disparity, labels, known, sizes)
    start = np.concatenate([[0], np.cumsum(known)])
    points = np.empty((4, start[-1]), np.float32)
    _gather(disparity, labels, weights, start[:-1].copy(), points)
    return points, start, sizes


@kernel
def _count_points(disparity, labels, known, sizes):
    width = labels.shape[1]
    for y in range(labels.shape[0]):
        x = 0
        while x < width:  # one run of a region after the other
            region, begin, n = labels[y, x], x, 0
            while x < width and labels[y, x] == region:
                n += 1 if disparity[y, x] == disparity[y, x] else 0
                x += 1
            known[region] += n
            sizes[region] += x - begin


@kernel
def _gather(disparity, labels, weights, place, points):
    height, width = labels.shape
    for y in range(height):
        x = 0
        while x < width:
            region = labels[y, x]
            n = place[region]
            while x < width and labels[y, x] == region:
                d = disparity[y, x]
                if d == d:
                    points[0, n], points[1, n], points[2, n], points[3, n] = x, y, d, weights[y, x]
                    n += 1
                x += 1
            place[region] = n


@part
def _random_index(seed, region, counter, n):
    """A number below n: splitmix64 of (seed, segment, counter)."""
    z = seed + U64(region) * U64(0xD1B54A32D192ED03) + U64(counter) * U64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> U64(30))) * U64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> U64(27))) * U64(0x94D049BB133111EB)
    return np.int64((z ^ (z >> U64(31))) >> U64(33)) % n


@kernel
def _fit(points, start, sizes, hypotheses, seed, first, end, coefficients, inlier_share, valid_share):
    """Fit the planes of regions first to end."""
    limit = F32(INLIER_DISTANCE**2)
    for s in range(first, end):
        own = slice(start[s], start[s + 1])
        x, y, d, w = points[0, own], points[1, own], points[2, own], points[3, own]
        coefficients[s, :] = np.nan
        inlier_share[s] = valid_share[s] = F32(0)
        if x.size > 0:
            valid_share[s] = F32(x.size / sizes[s])
        if x.size < MIN_POINTS:
            continue
        # Coordinates relative to the region's first point keep float32 sums exact enough.
        origin_x, origin_y = x[0], y[0]
        x -= origin_x
        y -= origin_y
        cost, a, b, c = _best_hypothesis(x, y, d, limit, hypotheses, seed, s)
        if cost >= F32(1e30):
            continue
        for _ in range(2):
            a, b, c = _least_squares(x, y, d, w, a, b, c, limit)
        inlier_share[s] = F32(_count_inliers(x, y, d, a, b, c, limit) / x.size)
        coefficients[s, 0], coefficients[s, 1] = a, b
        coefficients[s, 2] = np.float64(c) - np.float64(a) * origin_x - np.float64(b) * origin_y


@fast_part
def _best_hypothesis(x, y, d, limit, hypotheses, seed, region):
    """The plane through three random pixels with the smallest truncated squared error: (cost, a, b, c)."""
    n = x.size
    best, best_a, best_b, best_c = F32(1e30), F32(0), F32(0), F32(0)
    for h in range(hypotheses):
        i = _random_index(seed, region, 3 * h, n)
        j = _random_index(seed, region, 3 * h + 1, n)
        k = _random_index(seed, region, 3 * h + 2, n)
        x1, y1, d1 = x[j] - x[i], y[j] - y[i], d[j] - d[i]
        x2, y2, d2 = x[k] - x[i], y[k] - y[i], d[k] - d[i]
        area = x1 * y2 - x2 * y1
        if abs(area) < F32(MIN_TRIANGLE):
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


@fast_part
def _least_squares(x, y, d, weights, a, b, c, limit):
    """The weighted least-squares plane of the inliers of (a, b, c), relative to their centroid."""
    s = sx = sy = se = F32(0)
    inliers = 0
    for q in range(x.size):
        e = d[q] - a * x[q] - b * y[q] - c
        w = weights[q] if e * e < limit else F32(0)
        inliers += 1 if e * e < limit else 0
        s += w
        sx += w * x[q]
        sy += w * y[q]
        se += w * e
    if inliers < MIN_POINTS or not s > F32(0):
        return a, b, c
    mx, my, me = sx / s, sy / s, se / s
    xx = xy = yy = xe = ye = F32(0)
    for q in range(x.size):
        e = d[q] - a * x[q] - b * y[q] - c
        w = weights[q] if e * e < limit else F32(0)
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


@fast_part
def _count_inliers(x, y, d, a, b, c, limit):
    inliers = 0
    for q in range(x.size):
        e = a * x[q] + b * y[q] + c - d[q]
        inliers += 1 if e * e < limit else 0
    return inliers


def fit_planes_reference(
    disparity: Array, labels: Array, count: int, weights: Array, hypotheses: int, seed: int = 0
) -> Planes:
    """`fit_planes` in plain numpy and float64, one region after the other, with the same hypotheses."""
    planes = Planes(np.full((count, 3), np.nan), np.zeros(count, np.float32), np.zeros(count, np.float32))
    for s in range(count):
        y, x = np.nonzero(labels == s)
        known = np.isfinite(disparity[y, x])
        planes.valid_share[s] = known.mean() if known.size else 0
        if known.sum() < MIN_POINTS:
            continue
        points = np.stack([x[known], y[known], np.ones(known.sum())], axis=1).astype(np.float64)
        d = disparity[y, x][known].astype(np.float64)
        root = np.sqrt(weights[y, x][known].astype(np.float64))
        best, plane = np.inf, None
        for h in range(hypotheses):
            with np.errstate(over="ignore"):
                corners = [_random_index.py_func(U64(seed), s, 3 * h + i, len(d)) for i in range(3)]
            if abs(np.linalg.det(points[corners])) < MIN_TRIANGLE:
                continue
            candidate = np.linalg.solve(points[corners], d[corners])
            cost = float(np.minimum((points @ candidate - d) ** 2, INLIER_DISTANCE**2).sum())
            if cost < best:
                best, plane = cost, candidate
        if plane is None:
            continue
        for _ in range(2):
            inlier = (points @ plane - d) ** 2 < INLIER_DISTANCE**2
            if inlier.sum() >= MIN_POINTS:
                plane = np.linalg.lstsq(points[inlier] * root[inlier, None], d[inlier] * root[inlier], rcond=None)[0]
        planes.coefficients[s] = plane
        planes.inlier_share[s] = ((points @ plane - d) ** 2 < INLIER_DISTANCE**2).mean()
    return planes
