"""Selects the trusted matches, moves them to their median, and applies accepted planes.

Each step is one pass over the image, where numpy would need a dozen.
"""

from __future__ import annotations

import cv2
import numpy as np

from stages.compiled.jit import kernel, part
from stages.data import Array, PixelOrigin, known
from stages.refinement.kernels.holes import MIN_SURFACE_STEP
from stages.refinement.kernels.valid_extent import Extent

F32 = np.float32
UNKNOWN, MEASURED, OUT_OF_VIEW, UNIQUENESS, SKY = (
    int(PixelOrigin[name]) for name in ("UNKNOWN", "MEASURED", "OUT_OF_VIEW", "UNIQUENESS", "SKY")
)
_known = part(known)


def trusted_matches(
    pixels: Array, source: Array, confidence: Array, min_confidence: float, saturated: Array
) -> tuple[Array, Array, Array]:
    """The MEASURED disparities that count as matches.

    A saturated one, (H, W) bool, does not count, nor one as large as the image is wide. Returns the matches, (H, W)
    float32, NaN = none; their confidence, 0 = none; and `PixelOrigin` codes, (H, W) uint8: why the pixel is unknown
    if nothing fills it. Codes of unknown pixels are kept. A dropped match has SKY, OUT_OF_VIEW or UNIQUENESS.
    """
    matches, weights = np.empty(pixels.shape, np.float32), np.empty(pixels.shape, np.float32)
    reasons = np.empty(pixels.shape, np.uint8)
    _trust(F32(min_confidence), pixels, source, confidence, saturated, matches, weights, reasons)
    return matches, weights, reasons


def near_median(matches: Array, side: int, near: float) -> Array:
    """Each match moved to the median of its side x side px window where that is at most `near` px away.

    A match in a window of mostly holes has no median and stays. matches: (H, W) float32, NaN = unknown.
    """
    moved = np.empty(matches.shape, np.float32)
    _move_near(matches, cv2.medianBlur(np.fmax(matches, F32(-np.inf)), side), F32(near), moved)  # -inf for NaN
    return moved


def pull_to_planes(
    pixels: Array, coefficients: Array, labels: Array, within: Extent, near: float, weight: float, fill: bool,
    margin: int,
) -> tuple[Array, Array]:  # fmt: skip
    """Disparities within `near` px of their region's plane move towards it, and with `fill` holes take its value.

    pixels: (H, W) float32, px, NaN = hole; coefficients: (n, 3) float64 of the accepted planes, NaN for the others;
    labels: (H, W) int32; weight: of the plane; margin: px outside the valid extent `within` that are filled. A plane
    fills only values within the range of all pixels: others are extrapolated too far. If the left end of a hole is
    farther than the right one, the hole is occluded: a plane nearer to the right end does not fill it. Returns the
    disparities, (H, W) float32, and the pixels that a plane moved or filled, (H, W) bool.
    """
    pulled, applied = np.empty(pixels.shape, np.float32), np.empty(pixels.shape, np.bool_)
    low, high = (extreme.reduce(pixels.ravel(), keepdims=True)[0] for extreme in (np.fmin, np.fmax))
    _pull(pixels, coefficients, labels, within, F32(near), F32(weight), fill, margin, low, high, pulled, applied)
    return pulled, applied


def trusted_matches_reference(
    pixels: Array, source: Array, confidence: Array, min_confidence: float, saturated: Array
) -> tuple[Array, Array, Array]:
    """`trusted_matches` in plain numpy."""
    measured, doubted, outside = source == MEASURED, confidence < F32(min_confidence), abs(pixels) >= pixels.shape[1]
    trusted = measured & ~doubted & ~outside & ~saturated & ~np.isnan(pixels)
    dropped = [measured & saturated, measured & outside, measured & doubted, known(source)]
    reasons = np.select(dropped, [SKY, OUT_OF_VIEW, UNIQUENESS, UNKNOWN], source.astype(int)).astype(np.uint8)
    reasons[trusted] = UNKNOWN
    return np.where(trusted, pixels, F32(np.nan)), np.where(trusted, confidence, F32(0)), reasons


def near_median_reference(matches: Array, side: int, near: float) -> Array:
    """`near_median` by scipy's filter."""
    from scipy import ndimage  # takes long to import

    median = ndimage.median_filter(np.fmax(matches, F32(-np.inf)), side, mode="nearest")
    with np.errstate(invalid="ignore"):
        return np.where(abs(median - matches) <= F32(near), median, matches)


@kernel
def _trust(min_confidence, pixels, source, confidence, saturated, matches, weights, reasons):
    width = pixels.shape[1]
    for y in range(pixels.shape[0]):
        for x in range(width):
            code, size = source[y, x], abs(pixels[y, x])
            good = (code == MEASURED) & (confidence[y, x] >= min_confidence) & (size < width) & (not saturated[y, x])
            reasons[y, x] = UNKNOWN if _known(code) else code
            if code == MEASURED and not good:
                if saturated[y, x]:
                    reasons[y, x] = SKY
                elif size >= width:
                    reasons[y, x] = OUT_OF_VIEW
                elif confidence[y, x] < min_confidence:
                    reasons[y, x] = UNIQUENESS
            matches[y, x] = pixels[y, x] if good else F32(np.nan)
            weights[y, x] = confidence[y, x] if good else F32(0)


@kernel
def _move_near(matches, median, near, moved):
    for y in range(matches.shape[0]):
        for x in range(matches.shape[1]):
            d, m = matches[y, x], median[y, x]
            moved[y, x] = m if abs(m - d) <= near else d


@kernel
def _pull(pixels, coefficients, labels, within, near, weight, fill, margin, low, high, pulled, applied):
    height, width = pixels.shape
    for y in range(height):
        row = pixels[y]
        last, after, ceiling = -1, -1, high  # columns of the known pixels before and after x; bound of a plane
        for x in range(width):
            a, b, c = coefficients[labels[y, x]]
            d, plane = row[x], F32(a * x + b * y + c)
            if d == d:
                close = abs(plane - d) <= near
                pulled[y, x] = d + weight * (plane - d) if close else d
                applied[y, x] = close
                last = x
                continue
            if after < x:
                after = x + 1
                while after < width and row[after] != row[after]:
                    after += 1
                hidden = last >= 0 and after < width and row[after] - row[last] >= MIN_SURFACE_STEP
                ceiling = F32(0.5) * (row[last] + row[after]) if hidden else high
            reached = y >= within.top[x] - margin and x >= within.first[y] - margin and x <= within.last[y] + margin
            sane = fill and reached and plane >= low and plane <= ceiling
            pulled[y, x] = plane if sane else d
            applied[y, x] = sane


def pull_to_planes_reference(
    pixels: Array, coefficients: Array, labels: Array, within: Extent, near: float, weight: float, fill: bool,
    margin: int,
) -> tuple[Array, Array]:  # fmt: skip
    """`pull_to_planes` in plain numpy."""
    y, x = np.mgrid[: pixels.shape[0], : pixels.shape[1]]
    a, b, c = coefficients[labels].transpose(2, 0, 1)
    plane = (a * x + b * y + c).astype(np.float32)
    hole = np.isnan(pixels)
    with np.errstate(invalid="ignore"):
        close = np.abs(plane - pixels) <= F32(near)
    pulled = np.where(close, pixels + F32(weight) * (plane - pixels), pixels)
    if not fill or hole.all():
        return pulled, close
    column = np.arange(pixels.shape[1])
    left = np.maximum.accumulate(np.where(hole, -1, column), axis=1)
    right = np.flip(np.minimum.accumulate(np.flip(np.where(hole, len(column), column), axis=1), axis=1), axis=1)
    padded = np.pad(pixels, ((0, 0), (1, 1)), constant_values=np.nan)
    before, after = np.take_along_axis(padded, left + 1, axis=1), np.take_along_axis(padded, right + 1, axis=1)
    apart = after - before >= F32(MIN_SURFACE_STEP)
    ceiling = np.where(apart, F32(0.5) * (before + after), np.nanmax(pixels))
    reached = (y >= within.top - margin) & (x >= within.first[:, None] - margin) & (x <= within.last[:, None] + margin)
    sane = hole & reached & (plane >= np.nanmin(pixels)) & (plane <= ceiling)
    return np.where(sane, plane, pulled), close | sane
