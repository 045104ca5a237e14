"""Support that follows texture: planes over windows that grow until noise averages out.

How far a match may be off follows from the image: from its gradients along the row and its noise (the Cramer-Rao
bound). Where that is little, the match stays. Where it is much, the match moves to the plane of the matches around it,
and that plane to the plane of a larger window, each as far as noise explains the difference. A window leaves out blocks
of pixels that are off its plane, so it ends at the edge of a surface. See docs/refinement.md.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stages.compiled.jit import kernel, part
from stages.compiled.parallel import by_bands, shared_by
from stages.data import Array
from stages.matching.kernels.texture import (
    BLOCK,
    information,
    information_scale,
    match_variance,
    sky_end,
    stereo_noise,
    summed,
)
from stages.refinement.kernels.blocks import (
    BOUND,
    CORRELATION,
    EXPECTED,
    LANES,
    LL,
    LR,
    RESIDUAL,
    RR,
    VARIANCE,
    WEIGHT,
    A,
    B,
    C,
    N,
    block_sums,
    coarser,
    fit_windows,
)

F32 = np.float32
LEVELS = 3  # sizes of blocks: 4, 8 and 16 px; their windows are 20, 40 and 80 px wide
CORRELATED = 100.0  # px, the area over which the errors of matches are alike
EXCESS, EXACT = 1.95, 0.001  # of the errors over the bound; px^2, a variance at which half of its square is left
SYSTEMATIC = 0.015  # px, of what no averaging removes
BEND_REACH, MIN_BEND, MAX_BEND = 5, 0.01, 0.42  # px; an error is about as large as a bend is over the least one
PIXEL_SIGMAS, PIXEL_DEVIATION = 10.0, 0.1  # a match farther off the plane than both together is of another surface
MIN_BACKING = 4  # matches in the block of a guessed pixel that is supported
MIDDLE = 0.5 * (BLOCK - 1)  # of a block, from its first pixel
# Layers of the work array, LANES pixels each: those of four planes, then inputs and three results of the pixels
BASE, SLOPE, DROP, SHARE, SCATTER, UNCERTAIN, ALIKE, PLANES = range(8)
DISPARITY, OWN, NEAR, RESULT = range(4 * PLANES, 4 * PLANES + 4)
WORK_LAYERS = RESULT + 3
# Layers of a row: disparities by their place in a block, what a block has in common, and three results of each place
OF_DISPARITY, OF_OWN, OF_NEAR, OF_RESULT = 0, BLOCK, BLOCK + 1, BLOCK + 2
ROW_LAYERS = OF_RESULT + 3 * BLOCK


class Support(NamedTuple):
    """The result of `supported`.

    pixels: (H, W) float32, px, NaN = unknown; sigma: (H, W) float32, px, standard deviation of the error of a known
    pixel that is no blunder, inf = no evidence; correlation: (H, W) float32, -1 to 1, of the images' gradients
    over the pixels that support this one.
    """

    pixels: Array
    sigma: Array
    correlation: Array


def supported(
    pixels: Array,
    guessed: Array,
    left: Array,
    slopes: tuple[Array, Array],
    noise: Array,
    floor: float,
    threads: int = 1,
) -> Support:
    """Disparities with as much support as their texture asks for.

    pixels: (H, W) float32, px, NaN = unknown; guessed: (H, W) bool, pixels that are no evidence; left: (H, W) uint8;
    slopes: `texture.gradient` of left and right image; noise: (256,) float32, standard deviation of a pixel at each
    gray level; floor: px, standard deviation of a match of the best texture.
    """
    both = shared_by(threads)
    noise = stereo_noise(np.where(guessed, F32(np.nan), pixels), left, slopes, noise, threads)
    texture = information(left, slopes[0], noise, threads)
    variance, first_row = match_variance(texture, floor), sky_end(texture, left, noise)
    blocks = block_sums(pixels, guessed, left, slopes, information_scale(noise), LEVELS, both)
    blocks[VARIANCE, : variance.shape[0], : variance.shape[1]] = variance
    alike, matches = _correlated(blocks), blocks[N]
    planes, size = [fit_windows(blocks, None, BLOCK, both)], BLOCK
    for _ in range(1, LEVELS):
        blocks, start = coarser(blocks, planes[-1], size)
        size *= 2
        planes.append(fit_windows(blocks, start, size, both))
    shrunk, spread = _shrunk(planes)
    result = Support(*(np.empty(pixels.shape, np.float32) for _ in Support._fields))
    given = pixels, guessed, matches, shrunk, variance, spread, alike, first_row
    by_bands(both, len(pixels), lambda first, end: _blend(*given, first, end, *result))
    by_bands(both, len(pixels), lambda first, end: _add_bend(result.pixels, first, end, result.sigma))
    return result


def _correlated(blocks: Array) -> Array:
    """Correlation of the images' gradients over each 3 x 3 blocks, (rows, cols) float32."""
    lr, ll, rr = (summed(blocks[layer]) for layer in (LR, LL, RR))
    return np.asarray(lr / np.sqrt(np.maximum(ll * rr, F32(1e-9))))


def _shrunk(planes: list[Array]) -> tuple[Array, Array]:
    """The planes of the smallest blocks, moved to those of larger ones as far as noise explains the difference.

    Returns the planes, (PLANE_LAYERS, rows, cols), whose RESIDUAL is that of the smallest windows, and the variance of
    the planes, (rows, cols) float32, px^2.
    """
    result, size = planes[-1].copy(), BLOCK << len(planes) - 1
    spread = _plane_variance(result)
    for fine in reversed(planes[:-1]):
        size //= 2
        rows, cols = ((np.arange(extent) % 2).astype(np.float32) - F32(0.5) for extent in fine.shape[1:])
        coarse = result.repeat(2, axis=1).repeat(2, axis=2)
        coarse[C] += (coarse[A] * cols + coarse[B] * rows[:, np.newaxis]) * F32(size)
        noise = _averaged(fine)
        relief = np.maximum(coarse[RESIDUAL] - fine[RESIDUAL] - noise / 2, 0)
        apart = np.maximum(np.abs(coarse[C] - fine[C]) - 2 * np.sqrt(noise), 0)
        weight = noise / np.maximum(noise + relief + apart**2, F32(1e-12))  # 0 without matches
        result = fine.copy()
        for layer in (A, B, C, CORRELATION):
            result[layer] += weight * (coarse[layer] - fine[layer])
        spread = spread.repeat(2, axis=0).repeat(2, axis=1)
        spread = (1 - weight) ** 2 * _plane_variance(fine) + weight**2 * spread
    return result, spread


def _averaged(planes: Array) -> Array:
    """Variance of the planes by the noise of their matches, px^2."""
    return np.asarray(planes[EXPECTED] * np.minimum(F32(CORRELATED) / np.maximum(planes[WEIGHT], 1), 1))


def _plane_variance(planes: Array) -> Array:
    return np.asarray(np.minimum(np.maximum(_averaged(planes), planes[BOUND]), planes[EXPECTED]))


@kernel
def _blend(
    pixels, guessed, matches, planes, variance, spread, correlated, first_row, first, end, moved, sigma, correlation
):
    """Each pixel moves towards the planes of the four blocks around it, as far as it lies on them.

    Handled together are every fourth of 4 * LANES pixels: each of them lies alike between the middles of four blocks.
    These blocks are the same for BLOCK rows.
    """
    width, blocks = pixels.shape[1], variance.shape[1]
    work = np.zeros(WORK_LAYERS * LANES, np.float32)
    rows = np.zeros((BLOCK, ROW_LAYERS, blocks + 1 + LANES), np.float32)  # from the block left of the first one on
    for top in range((first - BLOCK // 2) // BLOCK, (end - 1 - BLOCK // 2) // BLOCK + 1):
        start = top * BLOCK + BLOCK // 2
        band = range(max(first, start), min(end, start + BLOCK))
        for y in band:
            _split(pixels[y], variance[y // BLOCK], correlated[y // BLOCK], rows[y - start])
        for left in range(-1, blocks, LANES):
            for k in range(4):
                _take_planes(planes, spread, top + k // 2, left + k % 2, work, PLANES * k)
            for y in band:
                row, down = rows[y - start], F32(y - start) + F32(0.5)
                for phase in range(BLOCK):
                    place = (BLOCK // 2 + phase) % BLOCK
                    at = left + 1 + (BLOCK // 2 + phase) // BLOCK
                    _copy_lanes(row[OF_DISPARITY + place, at:], work[DISPARITY * LANES :])
                    if phase % (BLOCK // 2) == 0:  # the next blocks
                        _copy_lanes(row[OF_OWN, at:], work[OWN * LANES :])
                        _copy_lanes(row[OF_NEAR, at:], work[NEAR * LANES :])
                    _mix(work, F32(phase) + F32(0.5), down)
                    for layer in range(3):
                        _copy_lanes(work[(RESULT + layer) * LANES :], row[OF_RESULT + 3 * place + layer, at:])
        for y in band:
            backing = matches[y // BLOCK]
            for x in range(width):
                d, block, result = pixels[y, x], x // BLOCK, rows[y - start, OF_RESULT + 3 * (x % BLOCK) :]
                stated = d == d and y >= first_row[x] and (not guessed[y, x] or backing[block] >= MIN_BACKING)
                moved[y, x] = result[0, block + 1] if d == d else d
                sigma[y, x] = result[1, block + 1] if stated else F32(np.inf)
                correlation[y, x] = result[2, block + 1] if stated else F32(0)


@part
def _split(pixels, variance, correlated, row):
    """Copy a row of pixels, apart by their place in a block, and of what its blocks have in common."""
    for x in range(pixels.size):
        row[OF_DISPARITY + x % BLOCK, x // BLOCK + 1] = pixels[x]
    for i in range(variance.size):
        row[OF_OWN, i + 1], row[OF_NEAR, i + 1] = variance[i], correlated[i]


@part
def _copy_lanes(source, target):
    for lane in range(LANES):
        target[lane] = source[lane]


@part
def _take_planes(planes, spread, j, start, work, layer):
    """Copy what `_mix` needs of LANES planes in row j; those beyond its ends, and without matches, have no share."""
    first, end = max(-start, 0), min(LANES, spread.shape[1] - start)
    work[layer * LANES : (layer + PLANES) * LANES] = 0
    if not 0 <= j < len(spread):
        return
    target, at, planes = work[layer * LANES :], start + first, planes[:, j]
    a, b, c, weight = planes[A, at:], planes[B, at:], planes[C, at:], planes[WEIGHT, at:]
    residual, alike, uncertain = planes[RESIDUAL, at:], planes[CORRELATION, at:], spread[j, at:]
    for lane in range(end - first):
        i = first + lane
        target[BASE * LANES + i], target[SLOPE * LANES + i], target[DROP * LANES + i] = c[lane], a[lane], b[lane]
        target[SHARE * LANES + i] = F32(1) if weight[lane] > 0 else F32(0)
        target[SCATTER * LANES + i], target[UNCERTAIN * LANES + i] = residual[lane], uncertain[lane]
        target[ALIKE * LANES + i] = alike[lane]


@part
def _mix(work, across, down):
    """The disparity, sigma and correlation of LANES pixels, `across`, `down` px from the middle of the first plane."""
    for i in range(LANES):
        d, own = work[DISPARITY * LANES + i], work[OWN * LANES + i]
        scale = F32(1) / (F32(PIXEL_SIGMAS) * np.sqrt(own) + F32(PIXEL_DEVIATION))
        weights, value, scatter, random, common = F32(0), F32(0), F32(0), F32(0), F32(0)
        for k in range(4):
            plane = PLANES * k * LANES + i
            aside, below = across - F32(BLOCK * (k % 2)), down - F32(BLOCK * (k // 2))
            base = work[plane + BASE * LANES] + work[plane + DROP * LANES] * below
            off = base + work[plane + SLOPE * LANES] * aside - d
            near = max(F32(1) - (off * scale) ** 2, F32(0))
            share = (F32(1) - abs(below) / F32(BLOCK)) * (F32(1) - abs(aside) / F32(BLOCK))
            weight = work[plane + SHARE * LANES] * share * near * near
            weights += weight
            value += weight * off
            scatter += weight * work[plane + SCATTER * LANES]
            random += weight * work[plane + UNCERTAIN * LANES]
            common += weight * work[plane + ALIKE * LANES]
        mean = F32(1) / max(weights, F32(1e-12))
        relief = max(scatter * mean - own, F32(0))
        share = own / (own + relief) * min(F32(2) * weights, F32(1))  # 0 without a plane
        random = share * share * random * mean + (F32(1) - share) * (F32(1) - share) * own
        alone = work[NEAR * LANES + i]
        work[RESULT * LANES + i] = d + share * value * mean
        random *= F32(EXCESS**2) * random / (random + F32(EXACT))
        work[(RESULT + 1) * LANES + i] = np.sqrt(random + F32(SYSTEMATIC**2))
        work[(RESULT + 2) * LANES + i] = min((F32(1) - share) * alone + share * common * mean, F32(2) * alone)


@kernel
def _add_bend(pixels, first, end, sigma):
    """Add, in place, how far over MIN_BEND each pixel is off the middle between those at BEND_REACH on both sides."""
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
            bend = max(min(bend, F32(MAX_BEND)) - F32(MIN_BEND), F32(0))
            sigma[y, x] = np.sqrt(sigma[y, x] * sigma[y, x] + bend * bend)


def add_bend_reference(pixels: Array, sigma: Array) -> Array:
    """`_add_bend` in plain numpy: the new standard deviations."""
    wide = np.pad(pixels.astype(np.float64), BEND_REACH, constant_values=np.nan)
    inner, bends = slice(BEND_REACH, -BEND_REACH), []
    for axis in (0, 1):
        both = sum(np.roll(wide, shift, axis)[inner, inner] for shift in (BEND_REACH, -BEND_REACH))
        bends.append(np.abs(both / 2 - pixels))
    return np.asarray(np.hypot(sigma, np.clip(np.nan_to_num(np.fmax(*bends)), MIN_BEND, MAX_BEND) - MIN_BEND))


def blend_reference(
    pixels: Array, guessed: Array, matches: Array, planes: Array, variance: Array, spread: Array, correlated: Array,
    first_row: Array,
) -> Support:  # fmt: skip
    """The last step of `supported`, in plain numpy and float64, pixel by pixel."""
    result = Support(pixels.astype(np.float64), np.full(pixels.shape, np.inf), np.zeros(pixels.shape))
    for y, x in np.argwhere(np.isfinite(pixels)):
        d, own, sums = float(pixels[y, x]), float(variance[y // BLOCK, x // BLOCK]), np.zeros(5)
        for j, i in np.ndindex(planes.shape[1:]):
            across, down = (place - number * BLOCK - (BLOCK - 1) / 2 for place, number in ((x, i), (y, j)))
            if max(abs(across), abs(down)) < BLOCK and planes[WEIGHT, j, i] > 0:
                plane = planes[:, j, i]
                off = plane[C] + plane[A] * across + plane[B] * down - d
                near = max(1 - (off / (PIXEL_SIGMAS * np.sqrt(own) + PIXEL_DEVIATION)) ** 2, 0) ** 2
                terms = 1, off, plane[RESIDUAL], spread[j, i], plane[CORRELATION]
                sums += (1 - abs(across) / BLOCK) * (1 - abs(down) / BLOCK) * near * np.array(terms, np.float64)
        mean, share = sums / max(sums[0], 1e-12), 0.0
        if sums[0] > 0:
            share = own / (own + max(mean[2] - own, 0)) * min(2 * sums[0], 1)
        result.pixels[y, x] = d + share * mean[1]
        if y >= first_row[x] and (not guessed[y, x] or matches[y // BLOCK, x // BLOCK] >= MIN_BACKING):
            random, near_correlation = share**2 * mean[3] + (1 - share) ** 2 * own, correlated[y // BLOCK, x // BLOCK]
            result.sigma[y, x] = np.sqrt(EXCESS**2 * random**2 / (random + EXACT) + SYSTEMATIC**2)
            result.correlation[y, x] = min(share * mean[4] + (1 - share) * near_correlation, 2 * near_correlation)
    return result
