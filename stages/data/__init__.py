"""The data that flows: frozen dataclasses, one for each kind of stage input or output.

Conventions: `stamp` is int nanoseconds of the log's clock; lengths are metres, angles radians. Arrays are read-only
once published. Unknown is NaN, or -1 where the type documents it, never a valid value.

Camera frame: left optical frame, x right, y down, z forward. Level frame: z up against gravity, x the rover's
horizontal heading, y left.
"""

from __future__ import annotations

from stages.data.arrays import Array
from stages.data.camera import CameraImage, CameraModel, ImageNoise, StereoCamera, StereoFrame
from stages.data.cloud import PointCloud, VoxelMap
from stages.data.disparity import Disparity, MatchHealth
from stages.data.maps import (
    LEVEL_FRAME,
    RIM_WIDTH,
    Cell,
    CellReason,
    ElevationMap,
    MatchFailure,
    NavigationMap,
    cell_centres,
)
from stages.data.motion import CameraMotion, Mount, Pose, Tilt, TiltHealth, Transform
from stages.data.pixel_validity import PixelOrigin, known
from stages.data.region import Region
from stages.data.rover import Rover
from stages.data.tiles import TILE_SIDE, Tiles

__all__ = [
    "LEVEL_FRAME",
    "RIM_WIDTH",
    "TILE_SIDE",
    "Array",
    "CameraImage",
    "CameraModel",
    "CameraMotion",
    "Cell",
    "CellReason",
    "Disparity",
    "ElevationMap",
    "ImageNoise",
    "MatchFailure",
    "MatchHealth",
    "Mount",
    "NavigationMap",
    "PixelOrigin",
    "PointCloud",
    "Pose",
    "Region",
    "Rover",
    "StereoCamera",
    "StereoFrame",
    "Tiles",
    "Tilt",
    "TiltHealth",
    "Transform",
    "VoxelMap",
    "cell_centres",
    "known",
]
