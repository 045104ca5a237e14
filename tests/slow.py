"""A stage that takes its time, so that a test can interrupt it."""

import time
from dataclasses import dataclass

from stages.data import StereoFrame


@dataclass(frozen=True)
class Nap:
    """Passes frames on after a second."""

    def __call__(self, frame: StereoFrame) -> StereoFrame:
        time.sleep(1.0)
        return frame
