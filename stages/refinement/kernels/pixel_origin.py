"""Where each refined disparity comes from, and what that is worth: calibrated, so that it is a probability."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from stages.compiled.jit import kernel
from stages.compiled.parallel import by_bands, shared_by
from stages.data import Array, PixelOrigin
from stages.refinement.kernels.holes import KEPT, MISMATCH

F32 = np.float32
OWN = 0.5, 0.75, 1.0
MEASURED, PLANE, FILLED = int(PixelOrigin.MEASURED), int(PixelOrigin.PLANE), int(PixelOrigin.FILLED)


class Trust(NamedTuple):
    """Share of pixels right within 1 px, by origin. Of a match: at the confidences `OWN` of its own."""

    agreed: tuple[float, float, float]  # a match that a plane agrees with
    alone: tuple[float, float, float]  # a match that none does
    replaced: float  # by its surroundings
    plane: float  # a hole that a plane fills
    mismatch: float  # a hole filled from about it
    occlusion: float  # and one that is hidden from the right camera


def label_origin(
    matches: Array, confidence: Array, agreed: Array, kinds: Array, refined: Array, borne_out: Array, reasons: Array,
    moved: float, trust: Trust, threads: int = 1,
) -> tuple[Array, Array]:  # fmt: skip
    """Source and confidence of each pixel, (H, W) uint8 codes of `PixelOrigin` and float32.

    matches: (H, W) float32, px, NaN = none, before refinement; confidence: (H, W) float32, theirs; agreed: (H, W) bool,
    where a plane had its say; kinds: (H, W) uint8 of `holes.fill_holes`; refined: (H, W) float32, the result;
    borne_out: (H, W) bool, where the images bear it out: elsewhere a match is a guess; reasons: (H, W) uint8, codes of
    the pixels that stay unknown; moved: px that a match may have
    moved and still be MEASURED.
    """
    source, worth = np.empty(matches.shape, np.uint8), np.empty(matches.shape, np.float32)
    steps = np.arange(256) / 255
    tables = np.array([np.interp(steps, OWN, values) for values in (trust.agreed, trust.alone)], np.float32)
    others = np.array(trust[2:], np.float32)

    def name(first: int, end: int) -> None:
        rows = slice(first, end)
        _name(
            matches[rows], confidence[rows], agreed[rows], kinds[rows], refined[rows], borne_out[rows], reasons[rows],
            F32(moved), tables, others, source[rows], worth[rows],
        )  # fmt: skip

    by_bands(shared_by(threads), len(matches), name)
    return source, worth


@kernel
def _name(matches, confidence, agreed, kinds, refined, borne_out, reasons, moved, tables, others, source, worth):
    replaced, plane, mismatch, occlusion = others
    for y in range(matches.shape[0]):
        for x in range(matches.shape[1]):
            d, match = refined[y, x], matches[y, x]
            if d != d:
                source[y, x], worth[y, x] = reasons[y, x], F32(0)
            elif abs(d - match) <= moved and not borne_out[y, x]:
                source[y, x], worth[y, x] = FILLED, mismatch
            elif abs(d - match) <= moved:
                source[y, x] = MEASURED
                step = np.int64(np.rint(min(max(confidence[y, x], F32(0)), F32(1)) * F32(255)))
                worth[y, x] = tables[0 if agreed[y, x] else 1, step]
            elif match == match:
                source[y, x], worth[y, x] = PLANE, replaced
            elif kinds[y, x] == KEPT:
                source[y, x], worth[y, x] = PLANE, plane
            else:
                source[y, x], worth[y, x] = FILLED, mismatch if kinds[y, x] == MISMATCH else occlusion


def name_sources_reference(
    matches: Array, confidence: Array, agreed: Array, kinds: Array, refined: Array, borne_out: Array, reasons: Array,
    moved: float, trust: Trust,
) -> tuple[Array, Array]:  # fmt: skip
    """`label_origin` in plain numpy."""
    own = np.rint(np.clip(confidence, 0, 1) * F32(255)).astype(np.float64) / 255
    stayed = np.abs(refined - matches) <= F32(moved)
    conditions = [
        np.isnan(refined), stayed & ~borne_out, stayed & agreed, stayed, np.isfinite(matches), kinds == KEPT,
        kinds == MISMATCH,
    ]  # fmt: skip
    codes: list[Any] = [reasons.astype(int), FILLED, MEASURED, MEASURED, PLANE, PLANE, FILLED]
    tables = [np.interp(own, OWN, values) for values in (trust.agreed, trust.alone)]
    worths: list[Any] = [0.0, trust.mismatch, *tables, trust.replaced, trust.plane, trust.mismatch]
    source = np.select(conditions, codes, FILLED).astype(np.uint8)
    return source, np.select(conditions, worths, trust.occlusion).astype(np.float32)
