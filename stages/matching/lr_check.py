"""Left-right check between two matchings of a pair (Hirschmüller, 2008, section 2.4), each from its own camera's view.

The matcher's own check asks the same sums twice, and paths that follow the left image's edges favour what the left
image shows. A second matching follows the right image's, so what only one camera sees is exposed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from flow.contracts import StageError
from stages.data import Disparity
from stages.matching.kernels.lr_check import drop_contradicted
from stages.stage import Stage, check_same_time, parameter


@dataclass(frozen=True)
class LeftRightCheck(Stage):
    """The disparity without the pixels that the right image's disparity contradicts.

    `backward` is the disparity of the swapped frame (stages.SwapViews). Where it is unknown it contradicts nothing.
    What it was not searched for it takes for something else: nearer pixels, from a prior, are not asked
    (`disparities`).
    """

    lr_tolerance: float = parameter(1.0, "largest difference that is no contradiction", unit="px", low=0)
    disparities: int = parameter(0, "search range of `backward`; 0: that of `disparity`", unit="px", low=0)
    threads: int = parameter(1, "most cores for one frame (two are used); never changes the result", low=1)

    def __call__(self, disparity: Disparity, backward: Disparity) -> Disparity:
        if disparity.pixels.shape != backward.pixels.shape:
            raise StageError(
                f"LeftRightCheck: the disparities have shapes {disparity.pixels.shape} and {backward.pixels.shape}; "
                "match the swapped frame at the same size"
            )
        check_same_time(self, disparity=disparity.stamp, backward=backward.stamp)
        found, theirs = ((layer.pixels, layer.source, layer.confidence) for layer in (disparity, backward))
        pixels, source, confidence = drop_contradicted(
            found, theirs, self.lr_tolerance, self.disparities or math.inf, self.threads
        )
        return replace(disparity, pixels=pixels, source=source, confidence=confidence)
