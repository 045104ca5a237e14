"""Left-right check between two disparity images, one of each camera's view (Hirschmüller, 2008, section 2.4).

`Match` has its own check, in kernels/selection.py: it uses the same sums twice, and their paths follow the edges of the
left image. A second matching follows the edges of the right image, so it reveals surfaces that only one camera sees.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from flow.contracts import StageError
from stages.data import Disparity
from stages.matching.kernels.lr_check import drop_inconsistent
from stages.stage import Stage, check_same_time, check_types, parameter


@dataclass(frozen=True)
class LeftRightCheck(Stage):
    """The disparity without pixels whose partner in the right image has another disparity.

    `backward` is the disparity of the swapped frame (stages.SwapViews). Pixels whose partner is unknown are kept, and
    so are pixels with a disparity that `backward` was not searched for (`disparities`).
    """

    lr_tolerance: float = parameter(1.0, "largest left-right difference", unit="px", low=0)
    disparities: int = parameter(0, "search range of `backward`; 0: that of `disparity`", unit="px", low=0)

    def __call__(self, disparity: Disparity, backward: Disparity) -> Disparity:
        """The left disparity without the pixels that `backward` contradicts; their source is LEFT_RIGHT."""
        check_types(self, disparity=disparity, backward=backward)
        if disparity.pixels.shape != backward.pixels.shape:
            raise StageError(
                f"LeftRightCheck: the disparities have shapes {disparity.pixels.shape} and {backward.pixels.shape}; "
                "match the swapped frame at the same size"
            )
        check_same_time(self, disparity=disparity.stamp, backward=backward.stamp)
        found, right = ((layer.pixels, layer.source, layer.confidence) for layer in (disparity, backward))
        pixels, source, confidence = drop_inconsistent(found, right, self.lr_tolerance, self.disparities or math.inf)
        return replace(disparity, pixels=pixels, source=source, confidence=confidence, costs=None)
