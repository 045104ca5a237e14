"""Semi-global matching (Hirschmüller, 2008; section 3.1 of the paper), compiled, in bytes, on any number of cores.

The cost is the census transform, by default with the truncated gradient difference, smoothed over 3x3. The sums of 8
paths decide the disparity, its fraction of a pixel, and whether left and right agree, in one go (stages.kernels.semiglobal).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stages.data import Array, Disparity, StereoFrame
from stages.kernels.prior import prior_costs
from stages.kernels.semiglobal import Rule, lanes_for, match
from stages.stage import Stage, parameter

SMALLEST_SIDE = 32
LARGEST_SUM = 255
# cost -> largest cost, cost outside the right image, default p1, default p2
COSTS = {"census": (24, 12, 12, 70), "census+gradient": (59, 40, 16, 100)}


@dataclass(frozen=True)
class Match(Stage):
    """Disparities of a rectified frame; unknown where no unique and consistent match was found.

    Penalties count in units of the matching cost: bits of census that differ, or, with the gradient, 1.5 units a bit.
    """

    disparities: int = parameter(192, "size of the search range", unit="px", low=1, high=1024)
    minimum: int = parameter(0, "smallest disparity searched", unit="px", low=-1024, high=1024)
    cost: str = parameter("census+gradient", "what is compared", choices=tuple(COSTS))
    paths: int = parameter(8, "directions of aggregation", choices=(4, 8))
    p1: int = parameter(0, "penalty of a step of 1 px; 0: the one that suits the cost", low=0, high=100)
    p2: int = parameter(0, "penalty of a larger step where the image is even; 0: the one that suits", low=0, high=230)
    edge: float = parameter(10.0, "step of brightness that halves p2", unit="gray levels", low=0.1)
    uniqueness: int = parameter(0, "by how much the best sum of paths must beat the next", low=0, high=254)
    consistency: int = parameter(2, "largest left-right difference", unit="px", low=0, high=64)
    speckle_size: int = parameter(40, "largest isolated patch that is dropped, in pixels", low=0)
    speckle_range: float = parameter(1.0, "disparity step that separates patches", unit="px", low=0)
    prior_weight: float = parameter(0.5, "cost of each pixel of distance from the prior", low=0, high=16)
    prior_reach: float = parameter(4.0, "distance from which the prior's cost grows no more", unit="px", low=0, high=64)
    threads: int = parameter(1, "most cores for one frame (two are used); never changes the result", low=1)
    memory: int = parameter(
        400, "for the sums of paths; larger frames are swept in bands, to the same result", unit="MB", low=1
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        largest, _, p1, p2 = self._costs()
        if not p2 > p1:
            raise ValueError(f"Match.p2 must be above Match.p1 = {p1}, not {p2}")
        if largest + p2 > LARGEST_SUM:
            raise ValueError(f"Match.p2 must be at most {LARGEST_SUM - largest} with cost '{self.cost}', not {p2}")

    def __call__(self, frame: StereoFrame, prior: Disparity | None = None) -> Disparity:
        left, right = (gray(image) for image in eight_bit(frame.left, frame.right))
        pulls = self._pulls(frame, prior)
        found = match(left, right, self._rule(), pulls, self.threads, self.memory << 20)
        return Disparity(frame.stamp, found.pixels, found.source, found.confidence, camera=frame.camera)

    def _costs(self) -> tuple[int, int, int, int]:
        largest, unseen, p1, p2 = COSTS[self.cost]
        return largest, unseen, self.p1 or p1, self.p2 or p2

    def _rule(self) -> Rule:
        _, unseen, p1, p2 = self._costs()
        table = np.maximum(p1 + 2, np.round(p2 / (1 + np.arange(256) / self.edge))).astype(np.uint8)
        return Rule(
            self.cost == "census+gradient", self.paths == 8, p1, table, unseen, self.disparities, self.minimum,
            self.uniqueness, self.consistency, self.speckle_range, self.speckle_size,
            (np.arange(256) / 255).astype(np.float32),
        )  # fmt: skip

    def _pulls(self, frame: StereoFrame, prior: Disparity | None) -> tuple[Array, Array] | None:
        if prior is None:
            return None
        return prior_costs(prior.pixels, self.minimum, lanes_for(self.disparities), self.prior_weight, self.prior_reach)


def eight_bit(*images: Array) -> tuple[Array, ...]:
    """uint8 copies of images of one exposure; 16-bit ones are stretched jointly, 0.1th to 99.9th percentile."""
    if all(image.dtype == np.uint8 for image in images):
        return images
    low, high = np.percentile(np.concatenate([image.ravel() for image in images]), (0.1, 99.9))
    scale = 255 / max(high - low, 1.0)
    return tuple(np.clip((image - low) * scale + 0.5, 0, 255).astype(np.uint8) for image in images)


def gray(image: Array) -> Array:
    """A gray or RGB uint8 image as gray (H, W) uint8."""
    luma: Array = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return luma
