"""The method: plain callables over the data types of `stages.data`."""

from stages.cloud.clean import Clean
from stages.cloud.level import Level
from stages.cloud.reproject import Reproject
from stages.cloud.voxel_grid import Voxels
from stages.data import (
    CameraImage,
    CameraModel,
    CameraMotion,
    Cell,
    Disparity,
    ElevationMap,
    MatchHealth,
    Mount,
    NavigationMap,
    PointCloud,
    Pose,
    Reason,
    Source,
    StereoCamera,
    StereoFrame,
    Tilt,
    TiltHealth,
    Transform,
    VoxelMap,
)
from stages.localisation.pose_filter import Locate
from stages.localisation.tilt.check import CheckTilt
from stages.localisation.visual_odometry import VisualOdometry
from stages.matching.lr_check import CrossCheck
from stages.matching.match import Match
from stages.matching.match_health import CheckMatches
from stages.matching.match_opencv import MatchOpenCV
from stages.matching.pyramid import Enlarge, Halve, Swap
from stages.rectification.rectify import Rectify
from stages.refinement.refine import Refine
from stages.terrain.binarise import Binarise
from stages.terrain.dem import Voxelise
from stages.terrain.features import Assess
from stages.terrain.fuse import Fuse

__all__ = [
    "Assess",
    "Binarise",
    "CameraImage",
    "CameraModel",
    "CameraMotion",
    "Cell",
    "CheckMatches",
    "CheckTilt",
    "Clean",
    "CrossCheck",
    "Disparity",
    "ElevationMap",
    "Enlarge",
    "Fuse",
    "Halve",
    "Level",
    "Locate",
    "Match",
    "MatchHealth",
    "MatchOpenCV",
    "Mount",
    "NavigationMap",
    "PointCloud",
    "Pose",
    "Reason",
    "Rectify",
    "Refine",
    "Reproject",
    "Source",
    "StereoCamera",
    "StereoFrame",
    "Swap",
    "Tilt",
    "TiltHealth",
    "Transform",
    "VisualOdometry",
    "VoxelMap",
    "Voxelise",
    "Voxels",
]
