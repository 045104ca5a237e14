"""Origin of each refined disparity, and its confidence: a calibrated probability."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array, PixelOrigin
from stages.refinement.kernels.holes import BRIDGE, KEPT, OCCLUSION
from stages.refinement.kernels.plane_fit import INLIER_DISTANCE

F32 = np.float32
MATCH_CONFIDENCES = 0.5, 0.75, 1.0
SIGMA_STEPS = 64  # in one px, of the table of the share of errors within 1 px
WITHIN = np.array([math.erf(SIGMA_STEPS / max(code, 1) / math.sqrt(2)) for code in range(256)], np.float32)
MEASURED, PLANE, FILLED = int(PixelOrigin.MEASURED), int(PixelOrigin.PLANE), int(PixelOrigin.FILLED)


class Trust(NamedTuple):
    """Share of pixels right within 1 px, by origin; for matches at the matcher's confidences `MATCH_CONFIDENCES`."""

    agreed: tuple[float, float, float]  # a match near its plane
    alone: tuple[float, float, float]  # a match without a plane near it
    backed: float  # a hole filled from its neighbours, with which both images agree
    replaced: float  # a match replaced by its neighbours
    plane: float  # a hole filled by a plane
    mismatch: float  # a hole filled from its neighbours, visible to both cameras
    occlusion: float  # a hole filled from its neighbours, occluded in the right camera


def label_origin(
    matches: Array, confidence: Array, agreed: Array, kinds: Array, refined: Array, consistent: Array, reasons: Array,
    sigma: Array, trust: Trust,
) -> tuple[Array, Array]:  # fmt: skip
    """Source and confidence of each pixel, (H, W) uint8 codes of `PixelOrigin` and float32.

    matches: (H, W) float32, px, NaN = none, before refinement; confidence: (H, W) float32 of the matches; agreed:
    (H, W) bool, pixels that a plane moved or filled; kinds: (H, W) uint8 of `fill_holes` and `bridge_holes`; refined:
    (H, W) float32, the result; consistent: (H, W) bool, pixels where the images agree with it; reasons: (H, W) uint8,
    codes of pixels that stay unknown; sigma: (H, W) float32, px, of the result, 0 = not stated.

    A MEASURED pixel differs from its match by at most `INLIER_DISTANCE` and two sigmas. A pixel that was filled or
    differs more is MEASURED where the images agree with it and its sigma is stated; a bridged one never is.
    """
    source, worth = np.empty(matches.shape, np.uint8), np.empty(matches.shape, np.float32)
    steps = np.arange(256) / 255
    tables = np.array(
        [np.interp(steps, MATCH_CONFIDENCES, values) for values in (trust.agreed, trust.alone)], np.float32
    )
    others = np.array(trust[2:], np.float32)
    _label(
        matches, confidence, agreed, kinds, refined, consistent, reasons, sigma, tables, others, source, worth
    )  # fmt: skip
    return source, worth


@kernel
def _label(
    matches, confidence, agreed, kinds, refined, consistent, reasons, sigma, tables, others, source, worth
):  # fmt: skip
    backed, replaced, plane, mismatch, occlusion = others
    for y in range(matches.shape[0]):
        for x in range(matches.shape[1]):
            d, match, kind = refined[y, x], matches[y, x], kinds[y, x]
            blur = np.int64(np.rint(min(sigma[y, x] * F32(SIGMA_STEPS), F32(255))))
            near = abs(d - match) <= F32(INLIER_DISTANCE) + F32(2) * sigma[y, x]
            if d != d:
                source[y, x], worth[y, x] = reasons[y, x], F32(0)
            elif near and not consistent[y, x]:
                source[y, x], worth[y, x] = FILLED, mismatch
            elif near:
                source[y, x] = MEASURED
                step = np.int64(np.rint(min(max(confidence[y, x], F32(0)), F32(1)) * F32(255)))
                worth[y, x] = tables[0 if agreed[y, x] else 1, step] * WITHIN[blur]
            elif match != match and kind != OCCLUSION and kind != BRIDGE and consistent[y, x] and sigma[y, x] > 0:
                source[y, x], worth[y, x] = MEASURED, backed * WITHIN[blur]
            elif match == match:
                source[y, x] = MEASURED if consistent[y, x] and sigma[y, x] > 0 else PLANE
                worth[y, x] = replaced
            elif kind == KEPT:
                source[y, x], worth[y, x] = PLANE, plane
            else:
                source[y, x], worth[y, x] = FILLED, occlusion if kind == OCCLUSION else mismatch


def label_origin_reference(
    matches: Array, confidence: Array, agreed: Array, kinds: Array, refined: Array, consistent: Array, reasons: Array,
    sigma: Array, trust: Trust,
) -> tuple[Array, Array]:  # fmt: skip
    """`label_origin` in plain numpy."""
    from scipy import special  # takes long to import

    own = np.rint(np.clip(confidence, 0, 1) * F32(255)).astype(np.float64) / 255
    stayed = np.abs(refined - matches) <= F32(INLIER_DISTANCE) + 2 * sigma
    blur = np.rint(np.minimum(sigma * F32(SIGMA_STEPS), 255)).astype(np.float64)
    within = special.erf(SIGMA_STEPS / np.maximum(blur, 1) / np.sqrt(2))
    conditions = [
        np.isnan(refined), stayed & ~consistent, stayed & agreed, stayed,
        np.isnan(matches) & ~np.isin(kinds, (OCCLUSION, BRIDGE)) & consistent & (sigma > 0), np.isfinite(matches),
        kinds == KEPT, kinds != OCCLUSION,
    ]  # fmt: skip
    moved = np.where(consistent & (sigma > 0), MEASURED, PLANE)
    codes: list[Any] = [reasons.astype(int), FILLED, MEASURED, MEASURED, MEASURED, moved, PLANE, FILLED]
    tables = [np.interp(own, MATCH_CONFIDENCES, values) * within for values in (trust.agreed, trust.alone)]
    backed = trust.backed * within
    worths: list[Any] = [0.0, trust.mismatch, *tables, backed, trust.replaced, trust.plane, trust.mismatch]
    source = np.select(conditions, codes, FILLED).astype(np.uint8)
    return source, np.select(conditions, worths, trust.occlusion).astype(np.float32)
