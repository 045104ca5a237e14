"""A prior disparity as a cost that attracts the search to it.

A disparity costs more the farther it is from the prior, up to a limit beyond which the images alone decide. The trick:
the costs of all disparities of a pixel are a stretch of one table, so a pixel only stores where its stretch begins.
Four tables serve priors in steps of a quarter pixel; a fifth, of zeros, serves pixels without a prior.
"""

from __future__ import annotations

import numpy as np

from stages.compiled.jit import kernel
from stages.compiled.parallel import by_bands, shared_by
from stages.data import Array

PHASES = 4
TABLE_MARGIN = 16  # lanes


def prior_costs(
    prior: Array, minimum: int | Array, lanes: int, weight: float, max_distance: float, threads: int = 1
) -> tuple[Array, Array]:
    """The index at which each pixel's costs begin, and the table of costs.

    prior: (H, W) float32, px, NaN = none; minimum: the smallest disparity searched, px, or that of each pixel, int32
    that broadcasts to (H, W); weight: cost per pixel of distance, in units of the matching cost; max_distance: px, from
    which the cost grows no more; threads: 2 share the work, with the same result. Returns (H, W) int32 and (m,) uint8.
    """
    far = (
        lanes + int(np.ceil(max_distance)) + TABLE_MARGIN
    )  # a prior so far outside the search range costs the same everywhere
    length = 2 * far + lanes
    place = np.arange(length) - far
    phase = np.arange(PHASES)[:, np.newaxis] / PHASES
    costs = np.clip(np.round(weight * np.minimum(np.abs(place - phase), max_distance)), 0, 255)
    table = np.concatenate([costs.ravel(), np.zeros(lanes)]).astype(np.uint8)
    begin, least = np.empty(prior.shape, np.int32), np.broadcast_to(minimum, prior.shape)

    def work(first: int, end: int) -> None:
        apart = np.subtract(prior[first:end], least[first:end], dtype=np.float32)
        _begin(apart, -PHASES * (far - lanes), PHASES * far, length, far, begin[first:end])

    by_bands(shared_by(threads), len(prior), work)
    return begin, table


@kernel
def _begin(apart, least, most, length, far, begin):
    for y in range(apart.shape[0]):
        for x in range(apart.shape[1]):
            quarters = np.rint(apart[y, x] * np.float32(PHASES))
            known = np.isfinite(quarters)
            whole = np.int64(min(max(quarters, least), most)) if known else 0
            begin[y, x] = (whole % PHASES) * length + far - whole // PHASES if known else PHASES * length


def prior_costs_reference(prior: Array, minimum: int, lanes: int, weight: float, reach: float) -> Array:
    """The costs that `prior_costs` describes, in plain numpy: (H, W, lanes) uint8."""
    place = np.rint((prior - np.float32(minimum)) * np.float32(PHASES)) / PHASES
    distance = np.minimum(np.abs(np.arange(lanes) - place[..., np.newaxis]), reach)
    distance[~np.isfinite(place)] = 0
    costs: Array = np.clip(np.round(weight * distance), 0, 255).astype(np.uint8)
    return costs
