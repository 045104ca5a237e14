"""Disparities summed over blocks of pixels, and planes fitted to windows of these blocks.

Sums count from the block's centre and mean disparity, so that they are exact in single precision. A plane is fitted
again to the residuals from an earlier one, with the weight of each block falling with its distance from that one.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import fast_kernel, fast_part, kernel
from stages.compiled.parallel import Fork, by_bands
from stages.data import Array
from stages.matching.kernels.texture import BLOCK

F32 = np.float32
MAX_DEVIATION = 0.4  # px, of a block that belongs to a plane, beside the noise of its matches
BLOCK_VARIANCES = 4.0  # times the variance of its matches, added to the square of that
SLOPE_WEIGHT = 10.0  # px^2 of matches that keep a plane's slope as it was
MAX_VARIANCE = 1e6  # px^2, of a plane without texture
NOISE_CORRELATION = 0.25  # of matched noise; what exceeds it is texture that both images show

BLOCKS = np.dtype([(name, np.float32) for name in (
    "n", "x", "y", "xx", "xy", "yy", "xd", "yd", "dd",  # matches, sums over them from the block's centre and mean
    "mean", "variance",  # of their disparities; expected of one disparity
    "lr", "ll", "rr",  # products of gradients in units of information, 1/px^2
)])  # fmt: skip
PLANES = np.dtype([(name, np.float32) for name in (
    "a", "b", "c",  # d = a x + b y + c, x and y from the block's centre
    "n", "residual", "variance",  # weight of the matches, their variance about the plane, and the expected one
    "bound", "correlation",  # variance of the plane by the images' gradients; correlation of these
)])  # fmt: skip


def block_sums(
    pixels: Array, guessed: Array, guide: Array, slopes: tuple[Array, Array], scale: Array, levels: int, both: Fork
) -> Array:
    """Sums over blocks of 4 x 4 px, (rows, cols) BLOCKS without variances.

    Blocks beyond the image are empty: `levels` sizes of blocks, each twice the one before, are all whole. pixels:
    (H, W) float32, px, NaN = none; guessed: (H, W) bool, pixels to leave out; guide: (H, W) uint8; slopes:
    `texture.gradient` of both images; scale: `texture.information_scale`.
    """
    rows, cols = (-(-extent // (BLOCK << levels - 1)) << levels - 1 for extent in pixels.shape)
    blocks = np.zeros((rows, cols), BLOCKS)
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
            columns = range(i * BLOCK, min((i + 1) * BLOCK, width))
            for y in rows:
                for x in columns:
                    d = pixels[y, x]
                    if d != d or guessed[y, x]:
                        continue
                    total += d
                    count += F32(1)
                    at = F32(x) - d
                    if F32(0) <= at <= F32(width - 1):
                        before, factor = int(at), scale[guide[y, x]]
                        one = F32(left[y, x])
                        here, beside = F32(right[y, before]), F32(right[y, min(before + 1, width - 1)])
                        other = here + (at - F32(before)) * (beside - here)
                        lr += one * other * factor
                        ll += one * one * factor
                        rr += other * other * factor
            if count == 0:
                continue
            block, mean = blocks[j, i], total / count
            block.n, block.mean, block.lr, block.ll, block.rr = count, mean, lr, ll, rr
            for y in rows:
                for x in columns:
                    if pixels[y, x] == pixels[y, x] and not guessed[y, x]:
                        u, v = F32(x - i * BLOCK) - F32(0.5 * (BLOCK - 1)), F32(y - j * BLOCK) - F32(0.5 * (BLOCK - 1))
                        e = pixels[y, x] - mean
                        block.x += u
                        block.y += v
                        block.xx += u * u
                        block.xy += u * v
                        block.yy += v * v
                        block.xd += u * e
                        block.yd += v * e
                        block.dd += e * e


def fit_windows(blocks: Array, start: Array | None, radius: int, size: int, both: Fork) -> Array:
    """The planes, (rows, cols) PLANES, of windows of 2 * radius + 1 blocks around each block of `size` px.

    start: planes that the windows' blocks have to be near; None: those of 3 x 3 blocks, whichever these are.
    """
    if start is None:
        level = np.zeros(blocks.shape, PLANES)
        level["c"] = blocks["mean"]
        start = _fitted(blocks, level, 1, size, False, both)
    return _fitted(blocks, start, radius, size, True, both)


def _fitted(blocks: Array, start: Array, radius: int, size: int, gated: bool, both: Fork) -> Array:
    planes = np.zeros(blocks.shape, PLANES)
    by_bands(both, len(blocks), lambda first, end: _fit(blocks, start, radius, F32(size), gated, first, end, planes))
    return planes


@fast_part
def _deviation(block, across, down, offset, a, b):
    """Sums of the residuals of a block's matches from a plane: alone, times x, times y, squared.

    offset: of the block's mean from the plane at its centre.
    """
    r = offset * block.n - a * block.x - b * block.y
    xr = block.xd + offset * block.x - a * block.xx - b * block.xy
    yr = block.yd + offset * block.y - a * block.xy - b * block.yy
    rr = block.dd + offset * (r - a * block.x - b * block.y) - a * block.xd - b * block.yd
    rr -= a * (block.xd - a * block.xx - b * block.xy) + b * (block.yd - a * block.xy - b * block.yy)
    return r, xr + across * r, yr + down * r, rr


@fast_kernel
def _fit(blocks, start, radius, size, gated, first, end, planes):
    height, width = blocks.shape
    for j in range(first, end):
        for i in range(width):
            a, b, c = start[j, i].a, start[j, i].b, start[j, i].c
            n, x, y, xx, xy, yy = F32(0), F32(0), F32(0), F32(0), F32(0), F32(0)
            r, xr, yr, rr, variance = F32(0), F32(0), F32(0), F32(0), F32(0)
            lr, left, right = F32(0), F32(0), F32(0)
            for down in range(max(-radius, -j), min(radius, height - 1 - j) + 1):
                for across in range(max(-radius, -i), min(radius, width - 1 - i) + 1):
                    block = blocks[j + down, i + across]
                    if block.n == 0:
                        continue
                    u, v = F32(across) * size, F32(down) * size
                    offset = block.mean - c - a * u - b * v
                    own_r, own_xr, own_yr, own_rr = _deviation(block, u, v, offset, a, b)
                    weight = F32(1)
                    if gated:
                        limit = F32(MAX_DEVIATION**2) + F32(BLOCK_VARIANCES) * block.variance
                        weight -= own_rr / (block.n * limit)
                        if weight <= 0:
                            continue
                        weight *= weight
                    n += weight * block.n
                    x += weight * (block.x + u * block.n)
                    y += weight * (block.y + v * block.n)
                    xx += weight * (block.xx + F32(2) * u * block.x + u * u * block.n)
                    xy += weight * (block.xy + u * block.y + v * block.x + u * v * block.n)
                    yy += weight * (block.yy + F32(2) * v * block.y + v * v * block.n)
                    r += weight * own_r
                    xr += weight * own_xr
                    yr += weight * own_yr
                    rr += weight * own_rr
                    variance += weight * block.n * block.variance
                    lr += weight * block.lr
                    left += weight * block.ll
                    right += weight * block.rr
            plane = planes[j, i]
            plane.a, plane.b, plane.c, plane.n = a, b, c, n
            plane.bound = F32(MAX_VARIANCE)
            if n < F32(1):
                plane.n = F32(0)
                continue
            mx, my, mr = x / n, y / n, r / n
            cxx, cxy, cyy = xx - mx * x + F32(SLOPE_WEIGHT), xy - mx * y, yy - my * y + F32(SLOPE_WEIGHT)
            cxr, cyr, crr = xr - mx * r, yr - my * r, rr - mr * r
            determinant = cxx * cyy - cxy * cxy
            da, db = (cxr * cyy - cyr * cxy) / determinant, (cyr * cxx - cxr * cxy) / determinant
            plane.a, plane.b, plane.c = a + da, b + db, c + mr - da * mx - db * my
            plane.residual = max((crr - da * cxr - db * cyr) / n, F32(0))
            plane.variance = variance / n
            both = np.sqrt(left * right)
            plane.correlation = lr / max(both, F32(1e-9))
            plane.bound = F32(1) / max(lr - F32(NOISE_CORRELATION) * both, F32(1e-9))


def coarser(blocks: Array, planes: Array, size: int) -> tuple[Array, Array]:
    """Blocks of twice the `size`, px, and planes to start from, about their centres."""
    rows, cols = blocks.shape
    whole, start = np.zeros((rows // 2, cols // 2), BLOCKS), np.zeros((rows // 2, cols // 2), PLANES)
    _coarsen(blocks, planes, F32(size), whole, start)
    return whole, start


@kernel
def _coarsen(blocks, planes, size, whole, start):
    """Blocks of twice the `size`, px, and the means of their planes, into `whole` and `start`."""
    for j in range(whole.shape[0]):
        for i in range(whole.shape[1]):
            total, n, weight, variance = F32(0), F32(0), F32(0), F32(0)
            for k in range(4):
                part = blocks[2 * j + k // 2, 2 * i + k % 2]
                total, n = total + part.n * part.mean, n + part.n
                variance += F32(0.25) * part.variance
                weight += planes[2 * j + k // 2, 2 * i + k % 2].n
            block, plane = whole[j, i], start[j, i]
            block.n, block.mean, block.variance = n, total / max(n, F32(1)), variance
            for k in range(4):
                part, own = blocks[2 * j + k // 2, 2 * i + k % 2], planes[2 * j + k // 2, 2 * i + k % 2]
                u, v = size * (F32(k % 2) - F32(0.5)), size * (F32(k // 2) - F32(0.5))
                e = part.mean - block.mean
                x, y = part.x + u * part.n, part.y + v * part.n
                block.x += x
                block.y += y
                block.xx += part.xx + u * (part.x + x)
                block.xy += part.xy + u * part.y + v * x
                block.yy += part.yy + v * (part.y + y)
                block.xd += part.xd + e * x
                block.yd += part.yd + e * y
                block.dd += part.dd + e * e * part.n
                block.lr += part.lr
                block.ll += part.ll
                block.rr += part.rr
                share = own.n / max(weight, F32(1e-6))
                plane.a += share * own.a
                plane.b += share * own.b
                plane.c += share * (own.c - own.a * u - own.b * v)


def block_sums_reference(
    pixels: Array, guessed: Array, guide: Array, slopes: tuple[Array, Array], scale: Array, size: int
) -> dict[str, Array]:
    """`block_sums` for blocks of `size` px in plain numpy and float64: the fields of BLOCKS without variance."""
    height, width = pixels.shape
    rows, cols = -(-height // size), -(-width // size)
    at = np.arange(width) - np.where(guessed, np.nan, pixels).astype(np.float64)
    inside = (at >= 0) & (at <= width - 1)
    left, right = (image.astype(np.float64) for image in slopes)
    partner = np.stack([np.interp(place, np.arange(width), row) for place, row in zip(at, right, strict=True)])
    one, other = (np.where(inside, image * np.sqrt(scale[guide]), 0) for image in (left, partner))
    sums = {name: np.zeros((rows, cols)) for name in BLOCKS.names or () if name != "variance"}
    for j, i in np.ndindex(rows, cols):
        block = np.s_[j * size : (j + 1) * size, i * size : (i + 1) * size]
        y, x = np.nonzero(np.isfinite(pixels[block]) & ~guessed[block])
        d = pixels[block][y, x].astype(np.float64)
        if not d.size:
            continue
        u, v, e = x - (size - 1) / 2, y - (size - 1) / 2, d - d.mean()
        terms = {
            "n": np.ones_like(d), "x": u, "y": v, "xx": u * u, "xy": u * v, "yy": v * v, "xd": u * e, "yd": v * e,
            "dd": e * e, "lr": (one * other)[block], "ll": (one * one)[block], "rr": (other * other)[block],
        }  # fmt: skip
        for name, values in terms.items():
            sums[name][j, i] = values.sum()
        sums["mean"][j, i] = d.mean()
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
