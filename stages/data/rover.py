"""The vehicle: the sizes and limits that decide what is a hazard to it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from flow.parameters import Checked, parameter


@dataclass(frozen=True)
class Rover(Checked):
    """The vehicle's body and its limits; the stages that need it share one value.

    Examples
    --------
    >>> Rover(max_step=0.25).max_step
    0.25
    """

    footprint: float = parameter(1.0, "width and length of the rover", unit="m", low=0.05, high=20.0)
    wheel_track: float = parameter(1.0, "distance between left and right wheels", unit="m", low=0.05, high=20.0)
    wheel: float = parameter(0.3, "diameter of a wheel", unit="m", low=0.05, high=5.0)
    max_step: float = parameter(0.2, "highest step that is not a hazard", unit="m", low=0.01, high=20.0)
    ground_clearance: float = parameter(
        0.25, "height of the rover's belly above the ground", unit="m", low=0.01, high=20.0
    )
    max_slope: float = parameter(
        math.radians(20), "steepest ground that is not a hazard", unit="rad", low=0.0, high=math.radians(89)
    )
