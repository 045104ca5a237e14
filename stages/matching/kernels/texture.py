"""What the texture of an image allows: how exact a match can be, and where it is none.

The Cramer-Rao bound of a disparity follows from the gradients along the row and the noise. A window of the census (5x5)
that has one gray value only cannot be matched at all: the paths carry disparities of other pixels into such a patch,
for example into a burnt-out sky.
"""

from __future__ import annotations

import cv2
import numpy as np

from stages.compiled.jit import fast_kernel, kernel
from stages.compiled.parallel import by_bands, shared_by
from stages.data import Array, PixelOrigin, StereoFrame
from stages.matching.intensity import gray_pair

F32 = np.float32
BLANK = int(PixelOrigin.BLANK)
WINDOW = 5  # px, of the census
BLOCK = 4  # px, side of the blocks that share one estimate
# Gradient along the row of a slightly smoothed image: smoothing removes more noise than texture.
DERIVATIVE, SMOOTHING = np.array([-0.5, -1, 0, 1, 0.5], np.float32), np.array([1, 2, 1], np.float32)
GRADIENT_GAIN, NOISE_GAIN = 16.0, 15.0  # its response to a slope of 1 per px; its variance for noise of variance 1
PATCH, DIFFERENT_SHARE = 16, 0.25  # px, and the share of patches whose images differ by noise alone
TEXTURE_PIXELS = 81  # whose gradients bound the error of a match
MIN_TEXTURE = 3.0  # information of three blocks in a row, 1/px^2, that noise alone hardly has
SKY_REACH, MAX_DEVIATIONS = 12, 3.0  # px below the first texture, and standard deviations of the noise, of sky
MIN_INFORMATION = 1e-3  # of a pixel, 1/px^2
# Standard deviation of a match whose bound is s: FLOOR and CEILING s^2 / (s^2 + HALF^2), added in squares; after a
# filter that averages matches, SMOOTH_FLOOR instead of FLOOR. Measured on ground away from depth edges.
FLOOR, SMOOTH_FLOOR, CEILING, HALF = 0.05, 0.03, 1.0, 0.42  # px
DETAIL_SCALE, RADIUS = 1.0, 3  # px: standard deviation and radius of the Gaussian that separates detail from the rest
WEIGHTS = cv2.getGaussianKernel(2 * RADIUS + 1, DETAIL_SCALE)[RADIUS:, 0]  # of that Gaussian, from its middle on
REACH = 2  # px, radius of the neighbourhood over which the power of the detail is measured
AREA, RING, LEAST_POWER = (2 * REACH + 1) ** 2, 2 * REACH + 1, 1e-6  # px; rows; squared gray levels


def gradient(image: Array) -> Array:
    """Gradient along the row, times GRADIENT_GAIN, (H, W) int16, of an image (H, W) uint8."""
    return cv2.sepFilter2D(image, cv2.CV_16S, DERIVATIVE, SMOOTHING, borderType=cv2.BORDER_REPLICATE)


def slopes(frame: StereoFrame) -> tuple[Array, Array]:
    """`gradient` of both images of a frame in gray."""
    left, right = frame.once(gray_pair)
    return gradient(left), gradient(right)


def information_scale(noise: Array) -> Array:
    """What a squared `gradient` is multiplied by to be information about a disparity, 1/px^2, at each gray level."""
    return (1 / (2 * GRADIENT_GAIN**2 * np.square(noise, dtype=np.float64))).astype(np.float32)


def stereo_noise(pixels: Array, image: Array, slopes: tuple[Array, Array], noise: Array, threads: int = 1) -> Array:
    """The noise (256,) that both images together show: at least the one given, of the left image alone.

    Compression removes the noise of smooth blocks, but not the differences of two images of the same ground.
    Parameters are those of `noise_ratio`.
    """
    return np.asarray(noise * F32(np.sqrt(max(noise_ratio(pixels, image, slopes, noise, threads), 1.0))))


def noise_ratio(pixels: Array, image: Array, slopes: tuple[Array, Array], noise: Array, threads: int = 1) -> float:
    """What the two images do not share at the disparities, over the noise of the left image: a ratio of variances.

    Above 1 where compression has removed the noise of smooth blocks; below 1 where fine texture looks like noise. 1
    where too few pixels have a disparity. pixels: (H, W) float32, px, NaN = none, disparities; image: left, (H, W)
    uint8; slopes: the images' `gradient`; noise: (256,) float32, standard deviation at each gray level.
    """
    rows, cols = (extent // PATCH for extent in image.shape)
    sums = np.zeros((2, rows, cols), np.float32)
    scale = information_scale(noise)
    by_bands(shared_by(threads), rows, lambda first, end: _add_differences(
        pixels, image, *slopes, scale, first, end, sums
    ))  # fmt: skip
    total, count = sums[:, sums[1] >= PATCH**2 / 4]
    if not count.size:
        return 1.0
    return float(np.quantile(total / count, DIFFERENT_SHARE)) / (NOISE_GAIN / GRADIENT_GAIN**2)


@kernel
def _add_differences(pixels, image, left, right, scale, first, end, sums):
    """Squared differences of the gradients at the disparity, as information, and their number; every other row."""
    width = pixels.shape[1]
    for y in range(first * PATCH, end * PATCH, 2):
        for x in range(sums.shape[2] * PATCH):
            at = F32(x) - pixels[y, x]
            if F32(0) <= at <= F32(width - 1):
                before = int(at)
                here, beside = F32(right[y, before]), F32(right[y, min(before + 1, width - 1)])
                difference = F32(left[y, x]) - here - (at - F32(before)) * (beside - here)
                sums[0, y // PATCH, x // PATCH] += difference * difference * scale[image[y, x]]
                sums[1, y // PATCH, x // PATCH] += F32(1)


def information(image: Array, slopes: Array, noise: Array, threads: int = 1) -> Array:
    """What the gradients contain about the disparity, 1/px^2, and the pixels of each block: (2, rows, cols) float32.

    What noise alone seems to contain is subtracted. Blocks are 4 x 4 px; the last ones may be cut. image: (H, W) uint8;
    slopes: its `gradient`; noise: (256,) float32, standard deviation at each gray level.
    """
    rows, cols = (-(-extent // BLOCK) for extent in image.shape)
    layers = np.zeros((2, rows, cols), np.float32)
    scale = information_scale(noise)
    by_bands(shared_by(threads), rows, lambda first, end: _add_texture(image, slopes, scale, first, end, layers))
    return layers


def match_variance(found: Array, floor: float = FLOOR) -> Array:
    """Expected variance of a match in each block, px^2, (rows, cols) float32; found: their `information`."""
    total, area = (summed(layer) for layer in found)
    bound = 1 / (TEXTURE_PIXELS * np.maximum(total / area, F32(MIN_INFORMATION)))
    return np.asarray(F32(floor**2) + (F32(CEILING) * bound / (bound + F32(HALF**2))) ** 2)


def sky_end(found: Array, image: Array, noise: Array) -> Array:
    """The row at which ground begins in each column, (W,) int64; what is above may be sky, whose matches are noise.

    Ground begins at the uppermost texture of the column. The block of 4 px that contains it may also contain sky:
    pixels that differ from those above the block by noise alone. found: the blocks' `information`; image: (H, W)
    uint8; noise: (256,) float32.
    """
    height, width = image.shape
    along = cv2.boxFilter(found[0], -1, (3, 1), normalize=False, borderType=cv2.BORDER_CONSTANT) >= F32(MIN_TEXTURE)
    first = np.where(along.any(axis=0), along.argmax(axis=0) * BLOCK, height).repeat(BLOCK)[:width]
    rows = first + np.arange(-3 * BLOCK, SKY_REACH)[:, np.newaxis]
    levels = image[np.clip(rows, 0, height - 1), np.arange(width)].astype(np.float32)
    sky = levels[: 2 * BLOCK].mean(axis=0)
    differ = np.abs(levels[3 * BLOCK :] - sky) > MAX_DEVIATIONS * noise[sky.astype(np.uint8)]
    return np.asarray(np.where((first > 0) & differ.any(axis=0), first + differ.argmax(axis=0), first))


def summed(layer: Array) -> Array:
    """Sums over 3 x 3 blocks, of a layer (rows, cols) float32."""
    return cv2.boxFilter(layer, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)


@kernel
def _add_texture(image, slopes, scale, first, end, layers):
    """Information of each block, less what noise alone seems to have, and its pixels."""
    height, width = image.shape
    noise_share = F32(0.5 * NOISE_GAIN / GRADIENT_GAIN**2)
    for y in range(first * BLOCK, min(end * BLOCK, height)):
        for x in range(width):
            slope = F32(slopes[y, x])
            layers[0, y // BLOCK, x // BLOCK] += slope * slope * scale[image[y, x]] - noise_share
            layers[1, y // BLOCK, x // BLOCK] += F32(1)


def without_noise(image: Array, variance: Array) -> Array:
    """An image (H, W) uint8 without noise whose `variance` in the detail is given at each gray level, (256,) float32.

    The trick: the last rows of each step are kept in rings, so that an image is read and written once.
    """
    result = np.empty_like(image)
    wide = cv2.copyMakeBorder(image, *(RADIUS + REACH,) * 4, cv2.BORDER_REFLECT_101)
    _reduce_noise(wide, WEIGHTS.astype(np.float32), variance, result)
    return result


@fast_kernel
def _reduce_noise(image, weights, variance, result):
    """Write the image without noise to `result`; it has a border of RADIUS + REACH px."""
    height, width = result.shape
    wide = width + 2 * REACH
    w0, w1, w2, w3 = weights[0], weights[1], weights[2], weights[3]
    mean, row = np.empty((RING, wide), np.float32), np.empty(wide + 2 * RADIUS, np.float32)
    detail, power = np.empty((RING, wide), np.float32), np.empty((RING, width), np.float32)
    for y in range(height + 2 * REACH):
        r0, r1, r2, r3, r4, r5, r6 = (
            image[y], image[y + 1], image[y + 2], image[y + 3], image[y + 4], image[y + 5], image[y + 6]
        )  # fmt: skip
        for x in range(wide + 2 * RADIUS):
            total = w0 * F32(r3[x]) + w1 * (F32(r2[x]) + F32(r4[x]))
            row[x] = total + w2 * (F32(r1[x]) + F32(r5[x])) + w3 * (F32(r0[x]) + F32(r6[x]))
        m, d, p = mean[y % RING], detail[y % RING], power[y % RING]
        for x in range(wide):
            total = w0 * row[x + 3] + w1 * (row[x + 2] + row[x + 4])
            m[x] = total + w2 * (row[x + 1] + row[x + 5]) + w3 * (row[x] + row[x + 6])
            d[x] = F32(r3[x + RADIUS]) - m[x]
        for x in range(width):
            p[x] = d[x] * d[x] + d[x + 1] * d[x + 1] + d[x + 2] * d[x + 2] + d[x + 3] * d[x + 3] + d[x + 4] * d[x + 4]
        if y < 2 * REACH:
            continue
        m, d, levels, target = mean[(y - REACH) % RING], detail[(y - REACH) % RING], r1[RADIUS + REACH :], result[y - 4]
        for x in range(width):
            row[x] = variance[levels[x]]
        for x in range(width):
            total = power[0, x] + power[1, x] + power[2, x] + power[3, x] + power[4, x]
            share = min(row[x] / max(total * F32(1 / AREA), F32(LEAST_POWER)), F32(1))
            level = m[x + REACH] + (F32(1) - share) * d[x + REACH]
            target[x] = np.uint8(min(max(level + F32(0.5), F32(0)), F32(255)))


def contrast(image: Array, first: int, end: int) -> Array:
    """The range of the gray levels in the window of each pixel of rows first to end, (end - first, W) uint8.

    image: (H, W) uint8.
    """
    start = max(first - WINDOW // 2, 0)
    rows = image[start : end + WINDOW // 2]
    found = cv2.morphologyEx(rows, cv2.MORPH_GRADIENT, np.ones((WINDOW, WINDOW), np.uint8))
    return np.asarray(found[first - start : end - start])


@kernel
def drop_unmatchable(contrast_left, contrast_right, excluded, pixels, evidence, source):
    """Drop, in place, the matches of excluded pixels, of blank windows and of pixels whose partner's window is blank.

    A pixel that is excluded or blank gets that reason whether it has a match or not.
    contrast_left, contrast_right: (H, W) uint8 of `contrast`; excluded: (H, W) uint8, why the pixel has no match in the
    range, a code of `PixelOrigin`, or 0; it may have no rows, which excludes nothing; pixels: (H, W) float32, px;
    evidence: (H, W) uint8; source: (H, W) uint8, codes of `PixelOrigin`.
    """
    last = pixels.shape[1] - 1
    for y in range(pixels.shape[0]):
        for x in range(pixels.shape[1]):
            reason = excluded[y, x] if excluded.shape[0] > 0 else np.uint8(0)
            if reason == 0 and contrast_left[y, x] == 0:
                reason = np.uint8(BLANK)
            if reason == 0 and evidence[y, x] > 0:
                partner = min(max(round(x - pixels[y, x]), 0), last)
                reason = np.uint8(BLANK) if contrast_right[y, partner] == 0 else reason
            if reason != 0:
                pixels[y, x], evidence[y, x], source[y, x] = np.nan, 0, reason


def drop_unmatchable_reference(
    contrast_left: Array, contrast_right: Array, excluded: Array, pixels: Array, evidence: Array, source: Array
) -> None:
    """`drop_unmatchable` in plain numpy."""
    columns = np.arange(pixels.shape[1])
    partner = np.clip(np.rint(columns - np.nan_to_num(pixels.astype(np.float64))), 0, columns[-1]).astype(int)
    blank = (contrast_left == 0) | ((evidence > 0) & (np.take_along_axis(contrast_right, partner, axis=1) == 0))
    reason = np.where(blank, np.uint8(BLANK), np.uint8(0))
    if len(excluded):
        reason = np.where(excluded > 0, excluded, reason)
    dropped = reason > 0
    pixels[dropped], evidence[dropped], source[dropped] = np.nan, 0, reason[dropped]


def information_reference(image: Array, slopes: Array, noise: Array) -> Array:
    """`information` in plain numpy and float64."""
    square = np.square(noise[image].astype(np.float64))
    seen = (np.square(slopes.astype(np.float64)) - NOISE_GAIN * square) / (2 * GRADIENT_GAIN**2 * square)
    rows, cols = (np.arange(0, extent, BLOCK) for extent in image.shape)
    layers = np.stack([seen, np.ones_like(seen)])
    sums: Array = np.add.reduceat(np.add.reduceat(layers, rows, axis=1), cols, axis=2)
    return sums


def without_noise_reference(image: Array, variance: Array) -> Array:
    """`without_noise` by OpenCV's filters, in float64: the gray levels before rounding."""
    pixels, row = image.astype(np.float64), np.concatenate([WEIGHTS[:0:-1], WEIGHTS])
    smooth = cv2.sepFilter2D(pixels, -1, row, row)
    detail = pixels - smooth
    power = np.maximum(cv2.sqrBoxFilter(detail, -1, (2 * REACH + 1,) * 2), LEAST_POWER)
    return np.asarray(np.clip(smooth + (1 - np.minimum(variance[image] / power, 1)) * detail, 0, 255))
