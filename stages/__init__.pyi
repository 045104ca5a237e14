from .cloud.clean import Clean
from .cloud.level import Level
from .cloud.reproject import Reproject
from .cloud.voxel_grid import VoxelGrid
from .data import (
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
from .localisation.pose_filter import PoseFilter
from .localisation.tilt.check import CheckTilt
from .localisation.visual_odometry import VisualOdometry
from .matching.image_noise import MeasureNoise
from .matching.lr_check import LeftRightCheck
from .matching.match import Match
from .matching.match_health import CheckMatches
from .matching.match_opencv import MatchOpenCV
from .matching.pyramid import Halve, SwapViews, Upsample
from .rectification.rectify import Rectify
from .refinement.paper import RefinePaper
from .refinement.refine import Refine
from .terrain.binarise import Binarise
from .terrain.dem import Voxelise
from .terrain.features import TerrainFeatures
from .terrain.fuse import Fuse, FuseRegion
from .terrain.map_region import MapRegion

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
