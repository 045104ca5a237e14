"""The disparities that a camera's height and tilt suggest."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np

from stages.data import Array, StereoCamera

UPSIDE_DOWN = (
    "by the tilt the rover is upside down, so no ground is below the horizon: z of the inclinometer's frame, or of the "
    "world of its orientation, points down (FRD, NED), or accelerations have the opposite sign; correct /tf_static, or "
    "convert the messages to frames whose z points up"
)
ROCK = 0.3  # m; height above the ground of what should still be within the search range
MAX_DISPARITIES = 1024  # that matchers search


def ground_disparity(camera: StereoCamera, up: Array, height: float) -> float:
    """The largest disparity, px, of level ground in view.

    A ray r = (x, y, 1) meets the ground at the depth height / -(up . r). So the disparity is fx * baseline * -(up . r)
    / height, which is largest in a corner of the image; 0 where no ground is in view.

    camera: of the rectified images; up: (3,) unit vector against gravity in the coordinates of the left image (x right,
    y down, z forward); height: of the camera above the ground, m.

    >>> camera = StereoCamera(fx=500, fy=500, cx=320, cy=240, baseline=0.2, width=640, height=480)
    >>> round(ground_disparity(camera, np.array([0.0, -1.0, 0.0]), height=1.0), 3)
    47.8
    """
    corners = itertools.product((0, camera.width - 1), (0, camera.height - 1))
    rays = [np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0]) for u, v in corners]
    inverse_depth = max(0.0, *(-float(up @ ray) for ray in rays)) / height
    offset = camera.cx_right - camera.cx  # of disparities whose principal points differ
    return max(0.0, camera.fx * camera.baseline * inverse_depth - offset) if inverse_depth else 0.0


def search_range(camera: StereoCamera, up: Array, height: float) -> dict[str, Any] | None:
    """The disparities of level ground and of a rock on it, px, a search range that holds both, and what is doubtful.

    None if the camera is not above the rock, which means that its height is unknown.
    """
    if height <= ROCK or not math.isfinite(height):
        return None
    ground, rock = (ground_disparity(camera, up, height - above) for above in (0.0, ROCK))
    doubt, most = "", min(camera.width, MAX_DISPARITIES)
    if ground >= most:
        doubt = (
            f"level ground would have up to {ground:.0f} px, but a search in these images ends at {most} px: "
            f"the baseline of {camera.baseline:g} m, or the height of {height:.2f} m, looks wrong"
        )
    return {
        "height_m": height,
        "ground_px": ground,
        "rock_px": rock,
        "range_px": 16.0 * max(1, math.ceil(min(rock + 1, most) / 16)),
        "doubt": doubt,
    }
