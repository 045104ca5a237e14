"""The method: plain callables over the data types of `stages.data`."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from stages.data import (
    CameraImage,
    CameraModel,
    CameraMotion,
    Cell,
    CellReason,
    Disparity,
    ElevationMap,
    ImageNoise,
    MatchFailure,
    MatchHealth,
    Mount,
    NavigationMap,
    PixelOrigin,
    PointCloud,
    Pose,
    Region,
    Rover,
    StereoCamera,
    StereoFrame,
    Tilt,
    TiltHealth,
    Transform,
    VoxelMap,
    known,
)

if TYPE_CHECKING:
    from stages.cloud.clean import Clean
    from stages.cloud.level import Level
    from stages.cloud.reproject import Reproject
    from stages.cloud.voxel_grid import VoxelGrid
    from stages.localisation.pose_filter import PoseFilter
    from stages.localisation.tilt.check import CheckTilt
    from stages.localisation.visual_odometry import VisualOdometry
    from stages.matching.image_noise import MeasureNoise
    from stages.matching.lr_check import LeftRightCheck
    from stages.matching.match import Match
    from stages.matching.match_health import CheckMatches
    from stages.matching.match_opencv import MatchOpenCV
    from stages.matching.pyramid import Halve, SwapViews, Upsample
    from stages.rectification.rectify import Rectify
    from stages.refinement.paper import RefinePaper
    from stages.refinement.refine import Refine
    from stages.terrain.binarise import Binarise
    from stages.terrain.dem import Voxelise
    from stages.terrain.features import TerrainFeatures
    from stages.terrain.fuse import Fuse, FuseRegion
    from stages.terrain.map_region import MapRegion

__all__ = [
    "Binarise",
    "CameraImage",
    "CameraModel",
    "CameraMotion",
    "Cell",
    "CellReason",
    "CheckMatches",
    "CheckTilt",
    "Clean",
    "Disparity",
    "ElevationMap",
    "Fuse",
    "FuseRegion",
    "Halve",
    "ImageNoise",
    "LeftRightCheck",
    "Level",
    "MapRegion",
    "Match",
    "MatchFailure",
    "MatchHealth",
    "MatchOpenCV",
    "MeasureNoise",
    "Mount",
    "NavigationMap",
    "PixelOrigin",
    "PointCloud",
    "Pose",
    "PoseFilter",
    "Rectify",
    "Refine",
    "RefinePaper",
    "Region",
    "Reproject",
    "Rover",
    "StereoCamera",
    "StereoFrame",
    "SwapViews",
    "TerrainFeatures",
    "Tilt",
    "TiltHealth",
    "Transform",
    "Upsample",
    "VisualOdometry",
    "VoxelGrid",
    "VoxelMap",
    "Voxelise",
    "known",
]

_HOMES = {
    "Binarise": "terrain.binarise",
    "CheckMatches": "matching.match_health",
    "CheckTilt": "localisation.tilt.check",
    "Clean": "cloud.clean",
    "Fuse": "terrain.fuse",
    "FuseRegion": "terrain.fuse",
    "Halve": "matching.pyramid",
    "LeftRightCheck": "matching.lr_check",
    "Level": "cloud.level",
    "MapRegion": "terrain.map_region",
    "Match": "matching.match",
    "MatchOpenCV": "matching.match_opencv",
    "MeasureNoise": "matching.image_noise",
    "PoseFilter": "localisation.pose_filter",
    "Rectify": "rectification.rectify",
    "Refine": "refinement.refine",
    "RefinePaper": "refinement.paper",
    "Reproject": "cloud.reproject",
    "SwapViews": "matching.pyramid",
    "TerrainFeatures": "terrain.features",
    "Upsample": "matching.pyramid",
    "VisualOdometry": "localisation.visual_odometry",
    "VoxelGrid": "cloud.voxel_grid",
    "Voxelise": "terrain.dem",
}


def __getattr__(name: str) -> Any:
    """Import on first use: a pipeline should not wait for stages that it does not have."""
    if name in _HOMES:
        return getattr(import_module(f"stages.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'stages' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
