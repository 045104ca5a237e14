"""Disparities summed over blocks of pixels, and planes fitted to windows of these blocks.

Sums count from the block's centre and mean disparity, so that they are exact in single precision. A plane is fitted
again to the residuals from an earlier one, with the weight of each block falling with its distance from that one. The
trick: windows of neighbouring blocks are summed side by side in one array, at constant distances, so the compiler knows
that nothing overlaps and vectorises. The blocks of a row are copied once for all the windows that contain them.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import fast_part, kernel
from stages.compiled.parallel import Fork, by_bands
from stages.data import Array
from stages.matching.kernels.texture import BLOCK

F32 = np.float32
MAX_DEVIATION = 0.4  # px, of a block that belongs to a plane, beside the noise of its matches
BLOCK_VARIANCES = 4.0  # times the variance of its matches, added to the square of that
SLOPE_WEIGHT = 10.0  # px^2 of matches that keep a plane's slope as it was
MAX_VARIANCE = 1e6  # px^2, of a plane without texture
NOISE_CORRELATION = 0.25  # of matched noise; what exceeds it is texture that both images show

# Layers of an array of blocks: matches, and sums over them from the block's centre and their mean disparity
N, X, Y, XX, XY, YY, XD, YD, DD = range(9)
MEAN, VARIANCE = 9, 10  # mean of the disparities; expected variance of one of them
LR, LL, RR = 11, 12, 13  # products of gradients in units of information, 1/px^2
BLOCK_LAYERS = 14
# Layers of an array of planes: d = a x + b y + c, x and y from the block's centre
A, B, C = range(3)
WEIGHT, RESIDUAL, EXPECTED = 3, 4, 5  # of the matches: their weight, variance about the plane, and the expected one
BOUND, CORRELATION = 6, 7  # variance of the plane by the images' gradients; correlation of these
PLANE_LAYERS = 8
LANES = 16  # windows that are summed side by side
RADIUS = 2  # blocks; windows are 5 x 5 blocks
WIDE = LANES + 2 * RADIUS  # blocks of a row that these windows contain
START, SUMS = 0, 3  # in the work array: the planes that the windows start from; sums over the windows:
S_N, S_X, S_Y, S_XX, S_XY, S_YY, S_R, S_XR, S_YR, S_RR, S_VARIANCE, S_LR, S_LL, S_RIGHT = range(SUMS, SUMS + 14)
WORK_LAYERS = SUMS + 14


def block_sums(
    pixels: Array, guessed: Array, guide: Array, slopes: tuple[Array, Array], scale: Array, levels: int, both: Fork
) -> Array:
    """Sums over blocks of 4 x 4 px, (BLOCK_LAYERS, rows, cols) float32, without variances.

    Blocks beyond the image are empty: `levels` sizes of blocks, each twice the one before, are all whole. pixels:
    (H, W) float32, px, NaN = none; guessed: (H, W) bool, pixels to leave out; guide: (H, W) uint8; slopes:
    `texture.gradient` of both images; scale: `texture.information_scale`.
    """
    rows, cols = (-(-extent // (BLOCK << levels - 1)) << levels - 1 for extent in pixels.shape)
    blocks = np.zeros((BLOCK_LAYERS, rows, cols), np.float32)
    given = pixels, guessed, guide, *slopes, scale
    used = -(-pixels.shape[0] // BLOCK)
    by_bands(both, used, lambda first, end: _gather(*given, first, end, blocks))
    return blocks


@kernel
def _gather(pixels, guessed, guide, left, right, scale, first, end, blocks):
    height, width = pixels.shape
    for j in range(first, end):
        for i in range((width + BLOCK - 1) // BLOCK):
            total, count = F32(0), F32(0)
            lr, ll, rr = F32(0), F32(0), F32(0)
            rows = range(j * BLOCK, min((j + 1) * BLOCK, height))
            columns = range(min(BLOCK, width - i * BLOCK))
            for y in rows:
                for column in columns:
                    x = np.uint64(i * BLOCK + column)  # without sign: numba looks for no negative index
                    d = pixels[y, x]
                    if d != d or guessed[y, x]:
                        continue
                    total += d
                    count += F32(1)
                    at = F32(x) - d
                    if F32(0) <= at <= F32(width - 1):
                        before, factor = int(at), scale[guide[y, x]]
                        one = F32(left[y, x])
                        here = F32(right[y, np.uint64(before)])
                        beside = F32(right[y, np.uint64(min(before + 1, width - 1))])
                        other = here + (at - F32(before)) * (beside - here)
                        lr += one * other * factor
                        ll += one * one * factor
                        rr += other * other * factor
            if count == 0:
                continue
            mean = total / count
            sx, sy, sxx, sxy, syy, sxd, syd, sdd = F32(0), F32(0), F32(0), F32(0), F32(0), F32(0), F32(0), F32(0)
            for y in rows:
                for column in columns:
                    x = np.uint64(i * BLOCK + column)
                    if pixels[y, x] == pixels[y, x] and not guessed[y, x]:
                        u, v = F32(column) - F32(0.5 * (BLOCK - 1)), F32(y - j * BLOCK) - F32(0.5 * (BLOCK - 1))
                        e = pixels[y, x] - mean
                        sx += u
                        sy += v
                        sxx += u * u
                        sxy += u * v
                        syy += v * v
                        sxd += u * e
                        syd += v * e
                        sdd += e * e
            block = blocks[:, j, i]
            block[N], block[X], block[Y], block[XX], block[XY], block[YY] = count, sx, sy, sxx, sxy, syy
            block[XD], block[YD], block[DD], block[MEAN] = sxd, syd, sdd, mean
            block[LR], block[LL], block[RR] = lr, ll, rr


def fit_windows(blocks: Array, start: Array | None, size: int, both: Fork) -> Array:
    """The planes, (PLANE_LAYERS, rows, cols) float32, of the windows around each block.

    size: of a block, px; start: planes that the windows' blocks have to be near; None: those of 3 x 3 blocks, whichever
    these are.
    """
    if start is None:
        level = np.zeros((3, *blocks.shape[1:]), np.float32)
        level[C] = blocks[MEAN]
        start = _fitted(blocks, level, 1, size, False, both)
    return _fitted(blocks, start, RADIUS, size, True, both)


def _fitted(blocks: Array, start: Array, radius: int, size: int, gated: bool, both: Fork) -> Array:
    planes = np.zeros((PLANE_LAYERS, *blocks.shape[1:]), np.float32)
    given = blocks, start, radius, F32(size), gated
    by_bands(both, blocks.shape[1], lambda first, end: _fit(*given, first, end, planes))
    return planes


@kernel
def _fit(blocks, start, radius, size, gated, first, end, planes):
    _, height, width = blocks.shape
    work, row = np.zeros(WORK_LAYERS * LANES, np.float32), np.zeros(BLOCK_LAYERS * WIDE, np.float32)
    for j in range(first, end):
        for i in range(0, width, LANES):
            work[SUMS * LANES :] = 0
            _copy(start, j, i, work, LANES, 3)
            for down in range(max(-radius, -j), min(radius, height - 1 - j) + 1):
                _copy(blocks, j + down, i - RADIUS, row, WIDE, BLOCK_LAYERS)
                for across in range(-radius, radius + 1):
                    _add(row[RADIUS + across :], work, F32(across) * size, F32(down) * size, gated)
            for lane in range(min(LANES, width - i)):
                _solve(work, lane, planes[:, j, i + lane])


@fast_part
def _copy(layers, j, start, target, count, depth):
    """Copy `count` values from `start` on of row j of the first `depth` layers; beyond the row they are 0."""
    if start >= 0 and start + count <= layers.shape[2]:
        for layer in range(depth):
            for lane in range(count):  # indices without sign: numba looks for no negative one, and the loop vectorises
                target[layer * count + lane] = layers[layer, np.uint64(j), np.uint64(start) + np.uint64(lane)]
        return
    for layer in range(depth):
        for lane in range(count):
            inside = 0 <= start + lane < layers.shape[2]
            target[layer * count + lane] = layers[layer, j, start + lane] if inside else F32(0)


@fast_part
def _add(row, work, u, v, gated):
    """Add one block of each of `LANES` windows, (u, v) px from its middle, to the window's sums.

    row: layers of WIDE blocks, from the block of the first window.
    """
    for i in range(LANES):
        n, x, y = row[N * WIDE + i], row[X * WIDE + i], row[Y * WIDE + i]
        xx, xy, yy = row[XX * WIDE + i], row[XY * WIDE + i], row[YY * WIDE + i]
        xd, yd, expected = row[XD * WIDE + i], row[YD * WIDE + i], row[VARIANCE * WIDE + i]
        a, b = work[(START + A) * LANES + i], work[(START + B) * LANES + i]
        # Residuals of the block's matches from the plane: their sum, times x, times y, squared
        offset = row[MEAN * WIDE + i] - work[(START + C) * LANES + i] - a * u - b * v
        r = offset * n - a * x - b * y
        xr, yr = xd + offset * x - a * xx - b * xy, yd + offset * y - a * xy - b * yy
        rr = row[DD * WIDE + i] + offset * (r - a * x - b * y) - a * xd - b * yd
        rr -= a * (xd - a * xx - b * xy) + b * (yd - a * xy - b * yy)
        weight = F32(1)
        if gated:
            limit = F32(MAX_DEVIATION**2) + F32(BLOCK_VARIANCES) * expected
            weight = max(F32(1) - rr / (max(n, F32(1)) * limit), F32(0))
            weight *= weight
        work[S_N * LANES + i] += weight * n
        work[S_X * LANES + i] += weight * (x + u * n)
        work[S_Y * LANES + i] += weight * (y + v * n)
        work[S_XX * LANES + i] += weight * (xx + F32(2) * u * x + u * u * n)
        work[S_XY * LANES + i] += weight * (xy + u * y + v * x + u * v * n)
        work[S_YY * LANES + i] += weight * (yy + F32(2) * v * y + v * v * n)
        work[S_R * LANES + i] += weight * r
        work[S_XR * LANES + i] += weight * (xr + u * r)
        work[S_YR * LANES + i] += weight * (yr + v * r)
        work[S_RR * LANES + i] += weight * rr
        work[S_VARIANCE * LANES + i] += weight * n * expected
        work[S_LR * LANES + i] += weight * row[LR * WIDE + i]
        work[S_LL * LANES + i] += weight * row[LL * WIDE + i]
        work[S_RIGHT * LANES + i] += weight * row[RR * WIDE + i]


@fast_part
def _solve(work, lane, plane):
    """The plane of the window in a lane, by least squares over its matches, as a change of the one it starts from."""
    a, b, c = work[(START + A) * LANES + lane], work[(START + B) * LANES + lane], work[(START + C) * LANES + lane]
    n, variance = work[S_N * LANES + lane], work[S_VARIANCE * LANES + lane]
    x, y, r = work[S_X * LANES + lane], work[S_Y * LANES + lane], work[S_R * LANES + lane]
    plane[A], plane[B], plane[C], plane[BOUND] = a, b, c, F32(MAX_VARIANCE)
    if n < F32(1):
        return
    mx, my, mr = x / n, y / n, r / n
    cxx = work[S_XX * LANES + lane] - mx * x + F32(SLOPE_WEIGHT)
    cyy = work[S_YY * LANES + lane] - my * y + F32(SLOPE_WEIGHT)
    cxy = work[S_XY * LANES + lane] - mx * y
    cxr, cyr = work[S_XR * LANES + lane] - mx * r, work[S_YR * LANES + lane] - my * r
    crr = work[S_RR * LANES + lane] - mr * r
    determinant = cxx * cyy - cxy * cxy
    da, db = (cxr * cyy - cyr * cxy) / determinant, (cyr * cxx - cxr * cxy) / determinant
    plane[A], plane[B], plane[C] = a + da, b + db, c + mr - da * mx - db * my
    plane[WEIGHT], plane[RESIDUAL] = n, max((crr - da * cxr - db * cyr) / n, F32(0))
    plane[EXPECTED] = variance / n
    both = np.sqrt(work[S_LL * LANES + lane] * work[S_RIGHT * LANES + lane])
    matched = work[S_LR * LANES + lane]
    plane[CORRELATION] = matched / max(both, F32(1e-9))
    plane[BOUND] = F32(1) / max(matched - F32(NOISE_CORRELATION) * both, F32(1e-9))


def coarser(blocks: Array, planes: Array, size: int) -> tuple[Array, Array]:
    """Blocks of twice the `size`, px, and planes to start from, about their centres."""
    _, rows, cols = blocks.shape
    whole, start = (np.zeros((layers, rows // 2, cols // 2), np.float32) for layers in (BLOCK_LAYERS, 3))
    _coarsen(blocks, planes, F32(size), whole, start)
    return whole, start


@kernel
def _coarsen(blocks, planes, size, whole, start):
    """Blocks of twice the `size`, px, and the means of their planes, into `whole` and `start`."""
    for j in range(whole.shape[1]):
        for i in range(whole.shape[2]):
            total, n, weight, variance = F32(0), F32(0), F32(0), F32(0)
            for k in range(4):
                part = blocks[:, 2 * j + k // 2, 2 * i + k % 2]
                total, n = total + part[N] * part[MEAN], n + part[N]
                variance += F32(0.25) * part[VARIANCE]
                weight += planes[WEIGHT, 2 * j + k // 2, 2 * i + k % 2]
            block, plane = whole[:, j, i], start[:, j, i]
            block[N], block[MEAN], block[VARIANCE] = n, total / max(n, F32(1)), variance
            for k in range(4):
                part, own = blocks[:, 2 * j + k // 2, 2 * i + k % 2], planes[:, 2 * j + k // 2, 2 * i + k % 2]
                u, v = size * (F32(k % 2) - F32(0.5)), size * (F32(k // 2) - F32(0.5))
                e = part[MEAN] - block[MEAN]
                x, y = part[X] + u * part[N], part[Y] + v * part[N]
                block[X] += x
                block[Y] += y
                block[XX] += part[XX] + u * (part[X] + x)
                block[XY] += part[XY] + u * part[Y] + v * x
                block[YY] += part[YY] + v * (part[Y] + y)
                block[XD] += part[XD] + e * x
                block[YD] += part[YD] + e * y
                block[DD] += part[DD] + e * e * part[N]
                for layer in (LR, LL, RR):
                    block[layer] += part[layer]
                share = own[WEIGHT] / max(weight, F32(1e-6))
                plane[A] += share * own[A]
                plane[B] += share * own[B]
                plane[C] += share * (own[C] - own[A] * u - own[B] * v)


def block_sums_reference(
    pixels: Array, guessed: Array, guide: Array, slopes: tuple[Array, Array], scale: Array, size: int
) -> Array:
    """`block_sums` for blocks of `size` px in plain numpy and float64: (BLOCK_LAYERS, rows, cols)."""
    height, width = pixels.shape
    rows, cols = -(-height // size), -(-width // size)
    at = np.arange(width) - np.where(guessed, np.nan, pixels).astype(np.float64)
    inside = (at >= 0) & (at <= width - 1)
    left, right = (image.astype(np.float64) for image in slopes)
    partner = np.stack([np.interp(place, np.arange(width), row) for place, row in zip(at, right, strict=True)])
    one, other = (np.where(inside, image * np.sqrt(scale[guide]), 0) for image in (left, partner))
    sums = np.zeros((BLOCK_LAYERS, rows, cols))
    for j, i in np.ndindex(rows, cols):
        block = np.s_[j * size : (j + 1) * size, i * size : (i + 1) * size]
        y, x = np.nonzero(np.isfinite(pixels[block]) & ~guessed[block])
        d = pixels[block][y, x].astype(np.float64)
        if not d.size:
            continue
        u, v, e = x - (size - 1) / 2, y - (size - 1) / 2, d - d.mean()
        terms = np.ones_like(d), u, v, u * u, u * v, v * v, u * e, v * e, e * e
        sums[: len(terms), j, i] = np.sum(terms, axis=1)
        sums[LR:, j, i] = [image[block].sum() for image in (one * other, one * one, other * other)]
        sums[MEAN, j, i] = d.mean()
    return sums


def fit_window_reference(points: Array, start: Array, variances: Array) -> tuple[Array, float]:
    """One window's plane (a, b, c) and its residual variance, by least squares over its matches, in float64.

    points: (n, 4) x, y, d from the window's centre, and the number of the block; start: (3,) the plane before;
    variances: (blocks,) expected of a match.
    """
    x, y, d, block = points.T
    off, index = d - (start[0] * x + start[1] * y + start[2]), block.astype(int)
    count = np.maximum(np.bincount(index, minlength=len(variances)), 1)
    square = np.bincount(index, off * off, minlength=len(variances)) / count
    root = np.maximum(1 - square / (MAX_DEVIATION**2 + BLOCK_VARIANCES * variances), 0)[index]
    terms = np.stack([x, y, np.ones_like(x)], axis=1) * root[:, None]
    ridge = np.sqrt(SLOPE_WEIGHT) * np.eye(2, 3)
    change = np.linalg.lstsq(np.vstack([terms, ridge]), np.append(off * root, [0, 0]), rcond=None)[0]
    left_over = off * root - terms @ change
    return start + change, float((left_over**2).sum() / (root**2).sum())
