"""Left-right check between two matchings of a pair (Hirschmüller, 2008, section 2.4), each from its own camera's view.

The matcher's own check asks the same sums twice, and paths that follow the left image's edges favour what the left
image shows. A second matching follows the right image's, so what only one camera sees is exposed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stages.data import Disparity, Source
from stages.kernels.contradiction import contradicted
from stages.stage import Stage, check_same_time, parameter


@dataclass(frozen=True)
class CrossCheck(Stage):
    """The disparity without the pixels that the right image's disparity contradicts.

    `backward` is the disparity of the swapped frame (stages.Swap). Where it is unknown it contradicts nothing. What it
    was not searched for it takes for something else: nearer pixels, from a prior, are not asked (`disparities`).
    """

    tolerance: float = parameter(1.0, "largest difference that is no contradiction", unit="px", low=0)
    disparities: int = parameter(0, "search range of `backward`; 0: that of `disparity`", unit="px", low=0)
    threads: int = parameter(1, "most cores for one frame (two are used); never changes the result", low=1)

    def __call__(self, disparity: Disparity, backward: Disparity) -> Disparity:
        if disparity.pixels.shape != backward.pixels.shape:
            raise ValueError(
                f"CrossCheck: the disparities have shapes {disparity.pixels.shape} and {backward.pixels.shape}; "
                "match the swapped frame at the same size"
            )
        check_same_time(self, disparity=disparity.stamp, backward=backward.stamp)
        seen = np.where(backward.source == Source.UNKNOWN, np.float32(np.nan), backward.pixels)
        wrong = contradicted(disparity.pixels, seen, self.tolerance, self.threads)
        if self.disparities:
            wrong &= disparity.pixels <= self.disparities
        return replace(
            disparity,
            pixels=np.where(wrong, np.float32(np.nan), disparity.pixels),
            source=np.where(wrong, np.uint8(Source.UNKNOWN), disparity.source),
            confidence=np.where(wrong, np.float32(0), disparity.confidence),
        )
