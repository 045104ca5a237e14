"""A prior disparity as a cost that attracts the search to it.

A disparity costs more the farther it is from the prior, up to a limit beyond which the images alone decide. The trick:
the costs of all disparities of a pixel are a stretch of one table, so a pixel only stores where its stretch begins.
Four tables serve priors in steps of a quarter pixel, for each weight; one of zeros serves pixels without a prior.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from stages.compiled.jit import kernel
from stages.data import Array
from stages.matching.kernels.texture import BLOCK

F32 = np.float32
PHASES = 4
GAINS, MAX_GAIN = 15, 8.0  # factors of the weight, 1 to the largest by halves, with tables of their own
TABLE_MARGIN = 16  # lanes


def prior_costs(
    prior: Array, minimum: int | Array, lanes: int, weight: float, max_distance: float, gain: Array | None = None
) -> tuple[Array, Array]:
    """The index at which each pixel's costs begin, and the table of costs.

    prior: (H, W) float32, px, NaN = none; minimum: the smallest disparity searched, px, or that of each pixel, int32
    that broadcasts to (H, W); weight: cost per pixel of distance, in units of the matching cost; max_distance: px, from
    which the cost grows no more; gain: what the weight is multiplied by in each block of 4 x 4 px, (rows, cols)
    float32, 1 to MAX_GAIN. Returns (H, W) int32 and (m,) uint8.
    """
    # A prior so far outside the search range costs the same everywhere.
    far = lanes + int(np.ceil(max_distance)) + TABLE_MARGIN
    length, gains = 2 * far + lanes, 1 if gain is None else GAINS
    table = _table(lanes, far, weight, max_distance, gains)
    begin, steps = np.empty(prior.shape, np.int32), np.zeros((0, 0), np.uint8)
    if gain is not None:
        steps = np.rint((gain - 1) * F32((GAINS - 1) / (MAX_GAIN - 1))).astype(np.uint8)
    apart = np.subtract(prior, minimum, dtype=np.float32)
    _begin(apart, -PHASES * (far - lanes), PHASES * far, length, far, steps, gains, begin)
    return begin, table


@lru_cache(maxsize=16)  # it takes as long as the rest for small images
def _table(lanes: int, far: int, weight: float, max_distance: float, gains: int) -> Array:
    """Costs by gain, phase and distance, then zeros: (m,) uint8."""
    place = np.arange(2 * far + lanes) - far
    phase = np.arange(PHASES)[:, np.newaxis] / PHASES
    distance = np.minimum(np.abs(place - phase), max_distance)
    factors = np.linspace(1, MAX_GAIN, gains)[:, np.newaxis, np.newaxis]
    costs = np.clip(np.round(weight * factors * distance), 0, 255)
    return np.concatenate([costs.ravel(), np.zeros(lanes)]).astype(np.uint8)


@kernel
def _begin(apart, least, most, length, far, steps, gains, begin):
    for y in range(apart.shape[0]):
        for x in range(apart.shape[1]):
            quarters = np.rint(apart[y, x] * np.float32(PHASES))
            known = np.isfinite(quarters)
            whole = np.int64(min(max(quarters, least), most)) if known else 0
            table = PHASES * (steps[y // BLOCK, x // BLOCK] if steps.size else 0)
            begin[y, x] = (
                (table + whole % PHASES) * length + far - whole // PHASES if known else gains * PHASES * length
            )


def prior_costs_reference(prior: Array, minimum: int, lanes: int, weight: float, reach: float) -> Array:
    """The costs that `prior_costs` describes, in plain numpy: (H, W, lanes) uint8."""
    place = np.rint((prior - np.float32(minimum)) * np.float32(PHASES)) / PHASES
    distance = np.minimum(np.abs(np.arange(lanes) - place[..., np.newaxis]), reach)
    distance[~np.isfinite(place)] = 0
    costs: Array = np.clip(np.round(weight * distance), 0, 255).astype(np.uint8)
    return costs
