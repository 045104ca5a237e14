"""A prior disparity as a cost: what is searched for is pulled towards what is known already.

Each disparity costs more the farther it is from the prior, up to a limit, beyond which the images alone decide. The
trick: the costs of all disparities of a pixel are a stretch of one table, so the pixel needs no more than the place
where its stretch begins. Four tables serve priors of a quarter pixel; a fifth, of zeros, pixels that have none.
"""

from __future__ import annotations

import numpy as np

from stages.data import Array
from stages.kernels.compiled import part
from stages.kernels.vectors import lanes_in, load, plus_capped, store

PHASES = 4
MARGIN = 16


def prior_costs(prior: Array, minimum: int, lanes: int, weight: float, reach: float) -> tuple[Array, Array]:
    """Where each pixel's costs begin, and the table.

    prior: (H, W) float32, px, NaN = none; weight: cost per pixel of distance, in the units of the matching cost; reach:
    px beyond which it costs no more. Returns (H, W) int32 and (m,) uint8.
    """
    far = lanes + int(np.ceil(reach)) + MARGIN  # a prior so far outside the search range costs the same everywhere
    length = 2 * far + lanes
    place = np.arange(length) - far
    phase = np.arange(PHASES)[:, np.newaxis] / PHASES
    costs = np.clip(np.round(weight * np.minimum(np.abs(place - phase), reach)), 0, 255)
    table = np.concatenate([costs.ravel(), np.zeros(lanes)]).astype(np.uint8)
    with np.errstate(invalid="ignore"):
        quarters = np.clip(np.round((prior - minimum) * PHASES), -PHASES * (far - lanes), PHASES * far)
        known = np.isfinite(quarters)
        quarters = np.where(known, quarters, 0).astype(np.int32)
    begin = (quarters % PHASES) * length + far - quarters // PHASES
    return np.where(known, begin, PHASES * length).astype(np.int32), table


@part
def add_prior(costs, begin, table, width):  # type: ignore[no-untyped-def]
    """Add the prior's costs to those of a row: costs (W * n,) uint8; begin: (W,) int32; table: of `prior_costs`."""
    n = lanes_in(width)
    for x in range(begin.size):
        store(costs, x * n, plus_capped(load(costs, x * n, width), load(table, begin[x], width)))
