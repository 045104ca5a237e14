"""The method: plain callables over the data types of `stages.data`."""

from stages.binarise import Binarise
from stages.clean import Clean
from stages.data import (
    CameraImage,
    CameraModel,
    CameraMotion,
    Cell,
    Disparity,
    ElevationMap,
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
)
from stages.level import Level
from stages.locate import Locate
from stages.match import Match
from stages.match_opencv import MatchOpenCV
from stages.odometry import VisualOdometry
from stages.rectify import Rectify
from stages.refine import Refine
from stages.reproject import Reproject
from stages.tilt_check import CheckTilt
from stages.voxelise import Voxelise

__all__ = [
    "Binarise",
    "CameraImage",
    "CameraModel",
    "CameraMotion",
    "Cell",
    "CheckTilt",
    "Clean",
    "Disparity",
    "ElevationMap",
    "Level",
    "Locate",
    "Match",
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
    "Tilt",
    "TiltHealth",
    "Transform",
    "VisualOdometry",
    "Voxelise",
]
