"""A prior disparity as a cost: what is searched for is pulled towards what is known already.

Each disparity costs more the farther it is from the prior, up to a limit, beyond which the images alone decide. The
trick: the costs of all disparities of a pixel are a stretch of one table, so the pixel needs no more than the place
where its stretch begins. Four tables serve priors of a quarter pixel; a fifth, of zeros, pixels that have none.
"""

from __future__ import annotations

import numpy as np

from stages.data import Array
from stages.kernels.compiled import kernel

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
    begin = np.empty(prior.shape, np.int32)
    _begin(prior, minimum, -PHASES * (far - lanes), PHASES * far, length, far, begin)
    return begin, table


@kernel
def _begin(prior, minimum, least, most, length, far, begin):  # type: ignore[no-untyped-def]
    for y in range(prior.shape[0]):
        for x in range(prior.shape[1]):
            quarters = np.rint((prior[y, x] - np.float32(minimum)) * np.float32(PHASES))
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
