"""The method: plain callables over the data types of `stages.data`."""

from stages.binarise import Binarise
from stages.clean import Clean
from stages.data import (
    CameraImage,
    CameraModel,
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
    Transform,
)
from stages.fuse import Fuse
from stages.level import Level
from stages.match import Match
from stages.match_opencv import MatchOpenCV
from stages.rectify import Rectify
from stages.refine import Refine
from stages.reproject import Reproject
from stages.voxelise import Voxelise

__all__ = [
    "Binarise",
    "CameraImage",
    "CameraModel",
    "Cell",
    "Clean",
    "Disparity",
    "ElevationMap",
    "Fuse",
    "Level",
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
    "Transform",
    "Voxelise",
]
