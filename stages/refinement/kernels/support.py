"""Support that follows texture: planes over windows that grow until noise averages out.

How far a match may be off follows from the image: from its gradients along the row and its noise (the Cramer-Rao
bound). Where that is little, the match stays. Where it is much, the match moves to the plane of the matches around it,
and that plane to the plane of a larger window, each as far as noise explains the difference. A window leaves out blocks
of pixels that are off its plane, so it ends at the edge of a surface. See docs/refinement.md.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stages.compiled.jit import kernel
from stages.compiled.parallel import by_bands, shared_by
from stages.data import Array
from stages.matching.kernels.texture import (
    BLOCK,
    gradient,
    information,
    information_scale,
    match_variance,
    sky_end,
    stereo_noise,
    summed,
)
from stages.refinement.kernels.blocks import block_sums, coarser, fit_windows

F32 = np.float32
LEVELS = 3  # sizes of blocks: 4, 8 and 16 px
RADIUS = 2  # blocks; windows of 5 x 5 blocks are 20, 40 and 80 px wide
CORRELATED = 100.0  # px, the area over which the errors of matches are alike
EXCESS, SYSTEMATIC = 1.9, 0.04  # of the errors over the bound; px, of what no averaging removes
BEND_REACH, MAX_BEND = 3, 0.45  # px; where the surface bends, an error is about as large as the bend
PIXEL_SIGMAS, PIXEL_DEVIATION = 10.0, 0.1  # a match farther off the plane than both together is of another surface
MIN_BACKING = 4  # matches in the block of a guessed pixel that is supported


class Support(NamedTuple):
    """The result of `supported`.

    pixels: (H, W) float32, px, NaN = unknown; sigma: (H, W) float32, px, standard deviation of the error of a known
    pixel that is no blunder, inf = no evidence; correlation: (H, W) float32, -1 to 1, of the images' gradients
    over the pixels that support this one.
    """

    pixels: Array
    sigma: Array
    correlation: Array


def supported(pixels: Array, guessed: Array, left: Array, right: Array, noise: Array, threads: int = 1) -> Support:
    """Disparities with as much support as their texture asks for.

    pixels: (H, W) float32, px, NaN = unknown; guessed: (H, W) bool, pixels that are no evidence; left, right: (H, W)
    uint8; noise: (256,) float32, standard deviation of a pixel at each gray level.
    """
    both = shared_by(threads)
    slopes = both(lambda: gradient(left), lambda: gradient(right))
    noise = stereo_noise(np.where(guessed, F32(np.nan), pixels), left, slopes, noise, threads)
    texture = information(left, slopes[0], noise, threads)
    variance, first_row = match_variance(texture), sky_end(texture, left, noise)
    blocks = block_sums(pixels, guessed, left, slopes, information_scale(noise), LEVELS, both)
    blocks["variance"][: variance.shape[0], : variance.shape[1]] = variance
    alike, smallest = _correlated(blocks), blocks
    planes, size = [fit_windows(blocks, None, RADIUS, BLOCK, both)], BLOCK
    for _ in range(1, LEVELS):
        blocks, start = coarser(blocks, planes[-1], size)
        size *= 2
        planes.append(fit_windows(blocks, start, RADIUS, size, both))
    shrunk, spread = _shrunk(planes)
    result = Support(*(np.empty(pixels.shape, np.float32) for _ in Support._fields))
    given = pixels, guessed, smallest, shrunk, variance, spread, alike, first_row
    by_bands(both, len(pixels), lambda first, end: _blend(*given, first, end, *result))
    by_bands(both, len(pixels), lambda first, end: _add_bend(result.pixels, first, end, result.sigma))
    return result


def _correlated(blocks: Array) -> Array:
    """Correlation of the images' gradients over each 3 x 3 blocks, (rows, cols) float32."""
    lr, ll, rr = (summed(np.ascontiguousarray(blocks[name])) for name in ("lr", "ll", "rr"))
    return np.asarray(lr / np.sqrt(np.maximum(ll * rr, F32(1e-9))))


def _shrunk(planes: list[Array]) -> tuple[Array, Array]:
    """The planes of the smallest blocks, moved to those of larger ones as far as noise explains the difference.

    Returns the planes, (rows, cols) PLANES, whose `residual` is that of the smallest windows, and the variance of the
    planes, (rows, cols) float32, px^2.
    """
    result, size = planes[-1].copy(), BLOCK << len(planes) - 1
    spread = _plane_variance(result)
    for fine in reversed(planes[:-1]):
        size //= 2
        rows, cols = np.ogrid[: fine.shape[0], : fine.shape[1]]
        coarse = result.repeat(2, axis=0).repeat(2, axis=1)
        c = coarse["c"] + (coarse["a"] * (cols % 2 - F32(0.5)) + coarse["b"] * (rows % 2 - F32(0.5))) * F32(size)
        noise = _averaged(fine)
        relief = np.maximum(coarse["residual"] - fine["residual"] - noise / 2, 0)
        apart = np.maximum(np.abs(c - fine["c"]) - 2 * np.sqrt(noise), 0)
        weight = noise / np.maximum(noise + relief + apart**2, F32(1e-12))  # 0 without matches
        result = fine.copy()
        for name, value in (("a", coarse["a"]), ("b", coarse["b"]), ("c", c), ("correlation", coarse["correlation"])):
            result[name] += weight * (value - fine[name])
        spread = spread.repeat(2, axis=0).repeat(2, axis=1)
        spread = (1 - weight) ** 2 * _plane_variance(fine) + weight**2 * spread
    return result, spread.astype(np.float32)


def _averaged(planes: Array) -> Array:
    """Variance of the planes by the noise of their matches, px^2."""
    return np.asarray(planes["variance"] * np.minimum(F32(CORRELATED) / np.maximum(planes["n"], 1), 1))


def _plane_variance(planes: Array) -> Array:
    return np.asarray(np.minimum(np.maximum(_averaged(planes), planes["bound"]), planes["variance"]))


@kernel
def _blend(
    pixels, guessed, blocks, planes, variance, spread, correlated, first_row, first, end, moved, sigma, correlation
):
    """Each pixel moves towards the planes of the four blocks around it, as far as it lies on them."""
    rows, cols = planes.shape
    middle = F32(0.5 * (BLOCK - 1))
    share_down, base, slope, residual, uncertain, alike = np.empty((6, 4), np.float32)
    for y in range(first, end):
        top = (y - BLOCK // 2) // BLOCK
        lower = (F32(y) - middle) / F32(BLOCK) - F32(top)
        for left in range(-1, (pixels.shape[1] - 1 - BLOCK // 2) // BLOCK + 1):
            start = left * BLOCK + BLOCK // 2
            for k in range(4):
                j, i = top + k // 2, left + k % 2
                share_down[k] = F32(0)
                if 0 <= j < rows and 0 <= i < cols and planes[j, i].n > 0:
                    plane = planes[j, i]
                    across, down = F32(start - i * BLOCK) - middle, F32(y - j * BLOCK) - middle
                    base[k], slope[k] = plane.c + plane.a * across + plane.b * down, plane.a
                    share_down[k] = lower if k >= 2 else F32(1) - lower
                    residual[k], uncertain[k], alike[k] = plane.residual, spread[j, i], plane.correlation
            for x in range(max(start, 0), min(start + BLOCK, pixels.shape[1])):
                d, j, i = pixels[y, x], y // BLOCK, x // BLOCK
                moved[y, x], sigma[y, x], correlation[y, x] = d, F32(np.inf), F32(0)
                if d != d:
                    continue
                own = variance[j, i]
                reach = F32(1) / (F32(PIXEL_SIGMAS) * np.sqrt(own) + F32(PIXEL_DEVIATION))
                farther = (F32(x) - middle) / F32(BLOCK) - F32(left)
                weights, value, scatter, random, common = F32(0), F32(0), F32(0), F32(0), F32(0)
                for k in range(4):
                    if share_down[k] > 0:
                        off = base[k] + slope[k] * F32(x - start) - d
                        near = max(F32(1) - (off * reach) ** 2, F32(0))
                        weight = share_down[k] * (farther if k % 2 else F32(1) - farther) * near * near
                        weights += weight
                        value += weight * off
                        scatter += weight * residual[k]
                        random += weight * uncertain[k]
                        common += weight * alike[k]
                share = F32(0)
                if weights > 0:
                    relief = max(scatter / weights - own, F32(0))
                    share = own / (own + relief) * min(F32(2) * weights, F32(1))
                    moved[y, x] = d + share * value / weights
                    random, common = share * share * random / weights, share * common / weights
                if y >= first_row[x] and (not guessed[y, x] or blocks[j, i].n >= MIN_BACKING):
                    random += (F32(1) - share) ** 2 * own
                    sigma[y, x] = np.sqrt(F32(EXCESS**2) * random + F32(SYSTEMATIC**2))
                    near_correlation = correlated[j, i]
                    mean = (F32(1) - share) * near_correlation + common
                    correlation[y, x] = min(mean, F32(2) * near_correlation)


@kernel
def _add_bend(pixels, first, end, sigma):
    """Add, in place, how far each pixel is off the middle between those at BEND_REACH on both sides."""
    height, width = pixels.shape
    for y in range(first, end):
        above, below = y - BEND_REACH, y + BEND_REACH
        for x in range(width):
            d, bend = pixels[y, x], F32(0)
            if above >= 0 and below < height:
                off = F32(0.5) * abs(pixels[above, x] + pixels[below, x] - d - d)
                bend = off if off > bend else bend
            if BEND_REACH <= x < width - BEND_REACH:
                off = F32(0.5) * abs(pixels[y, x - BEND_REACH] + pixels[y, x + BEND_REACH] - d - d)
                bend = off if off > bend else bend
            bend = min(bend, F32(MAX_BEND))
            sigma[y, x] = np.sqrt(sigma[y, x] * sigma[y, x] + bend * bend)


def add_bend_reference(pixels: Array, sigma: Array) -> Array:
    """`_add_bend` in plain numpy: the new standard deviations."""
    wide = np.pad(pixels.astype(np.float64), BEND_REACH, constant_values=np.nan)
    inner, bends = slice(BEND_REACH, -BEND_REACH), []
    for axis in (0, 1):
        both = sum(np.roll(wide, shift, axis)[inner, inner] for shift in (BEND_REACH, -BEND_REACH))
        bends.append(np.abs(both / 2 - pixels))
    return np.asarray(np.hypot(sigma, np.minimum(np.nan_to_num(np.fmax(*bends)), MAX_BEND)))


def blend_reference(
    pixels: Array, guessed: Array, blocks: Array, planes: Array, variance: Array, spread: Array, correlated: Array,
    first_row: Array,
) -> Support:  # fmt: skip
    """The last step of `supported`, in plain numpy and float64, pixel by pixel."""
    result = Support(pixels.astype(np.float64), np.full(pixels.shape, np.inf), np.zeros(pixels.shape))
    for y, x in np.argwhere(np.isfinite(pixels)):
        d, own, sums = float(pixels[y, x]), float(variance[y // BLOCK, x // BLOCK]), np.zeros(5)
        for j, i in np.ndindex(planes.shape):
            across, down = (place - number * BLOCK - (BLOCK - 1) / 2 for place, number in ((x, i), (y, j)))
            if max(abs(across), abs(down)) < BLOCK and planes[j, i]["n"] > 0:
                off = planes[j, i]["c"] + planes[j, i]["a"] * across + planes[j, i]["b"] * down - d
                near = max(1 - (off / (PIXEL_SIGMAS * np.sqrt(own) + PIXEL_DEVIATION)) ** 2, 0) ** 2
                terms = 1, off, planes[j, i]["residual"], spread[j, i], planes[j, i]["correlation"]
                sums += (1 - abs(across) / BLOCK) * (1 - abs(down) / BLOCK) * near * np.array(terms, np.float64)
        mean, share = sums / max(sums[0], 1e-12), 0.0
        if sums[0] > 0:
            share = own / (own + max(mean[2] - own, 0)) * min(2 * sums[0], 1)
        result.pixels[y, x] = d + share * mean[1]
        if y >= first_row[x] and (not guessed[y, x] or blocks["n"][y // BLOCK, x // BLOCK] >= MIN_BACKING):
            random, near_correlation = share**2 * mean[3] + (1 - share) ** 2 * own, correlated[y // BLOCK, x // BLOCK]
            result.sigma[y, x] = np.sqrt(EXCESS**2 * random + SYSTEMATIC**2)
            result.correlation[y, x] = min(share * mean[4] + (1 - share) * near_correlation, 2 * near_correlation)
    return result
