"""The calibration of a stereo pair from files of ROS, Kalibr, EuRoC (ASL) or OpenCV.

The format is known by its keys. A transform T_a_b takes points of b to a; the names differ in each format, so the key
decides: Kalibr's T_cam_imu and T_imu_cam are inverse to each other, and EuRoC's T_BS is the pose of the sensor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from recordings.calibration.yaml_files import numbers, read_yaml
from recordings.errors import LogError
from stages.data import Array, CameraModel

MAX_BASELINE_M = 10.0  # a longer one is in millimetres
_MODELS = {
    "radtan": "plumb_bob",
    "radial-tangential": "plumb_bob",
    "plumb_bob": "plumb_bob",
    "rational_polynomial": "rational_polynomial",
    "equidistant": "equidistant",
    "kannala_brandt": "equidistant",
    "fisheye": "equidistant",
    "none": "plumb_bob",
}
_COEFFICIENTS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,)}
_KNOWN = "camera_info of ROS, a camchain of Kalibr, two sensor.yaml of EuRoC, or a stereo calibration of OpenCV"


@dataclass(frozen=True)
class StereoCalibration:
    """The content of the calibration files of a pair.

    models: left and right; p is zero where the file has no projection; right_in_left: (4, 4) from the right camera to
    the left one, None if the projections contain the baseline; camera_from_imu: (4, 4), to the left camera, if known;
    topics: of their images, if the file names them.
    """

    models: tuple[CameraModel, CameraModel]
    right_in_left: Array | None = None
    camera_from_imu: Array | None = None
    topics: tuple[str, str] = ("", "")

    @property
    def baseline(self) -> float:
        """How far the right camera is to the right of the left one, m."""
        if self.right_in_left is not None:
            return float(self.right_in_left[0, 3])
        left, right = (float(model.p[0, 3] / model.p[0, 0]) if model.p[0, 0] else 0.0 for model in self.models)
        return left - right

    def exchanged(self) -> StereoCalibration:
        """The calibration with left and right exchanged."""
        left, right = self.models
        moved = None if self.right_in_left is None else np.linalg.inv(self.right_in_left)
        imu = self.camera_from_imu
        if moved is not None and imu is not None:
            imu = moved @ imu
        return StereoCalibration((right, left), moved, imu, self.topics[::-1])


def read_calibration(paths: Sequence[Path]) -> StereoCalibration:
    """The calibration in one to three files. Raises LogError for other files."""
    named = [(str(path), read_yaml(path)) for path in paths]
    where, all_keys = " and ".join(name for name, _ in named), {key for _, content in named for key in content}
    if {"cam0", "cam1"} <= all_keys:
        made = _kalibr(_merged(named), where)
    elif {"left", "right"} <= all_keys:
        whole = _merged(named)
        made = _ros([(f"'{side}' of {where}", _mapping(whole, side, where)) for side in ("left", "right")])
    elif len(named) == 2 and all("T_BS" in content for _, content in named):
        made = _euroc(named)
    elif len(named) == 2 and all({"projection_matrix", "P", "p"} & content.keys() for _, content in named):
        made = _ros(named)
    elif "T_BS" in all_keys or {"projection_matrix", "P", "p"} & all_keys:
        raise LogError(f"{where} is the calibration of one camera; give a list of two files, left first")
    else:
        made = _opencv(named, where)
    for model, side in zip(made.models, ("left", "right"), strict=True):
        if model.unusable and not model.p.any():
            raise LogError(f"the {side} camera of {where} cannot be used: {model.unusable}")
    if made.right_in_left is not None:
        baseline = float(np.linalg.norm(made.right_in_left[:3, 3]))
        if not 0 < baseline <= MAX_BASELINE_M:
            raise LogError(f"the cameras of {where} are {baseline:g} m apart, which is not a baseline; give metres")
    return made


def _kalibr(content: Mapping[str, Any], where: str) -> StereoCalibration:
    cams = [_mapping(content, name, where) for name in ("cam0", "cam1")]
    named = [f"{name} of {where}" for name in ("cam0", "cam1")]
    models = tuple(_pinhole(cam, name, "distortion_coeffs") for cam, name in zip(cams, named, strict=True))
    imus = [_from_imu(cam, name) for cam, name in zip(cams, named, strict=True)]
    if "T_cn_cnm1" in cams[1]:
        right_in_left = np.linalg.inv(_rigid(cams[1], "T_cn_cnm1", named[1]))
    elif imus[0] is not None and imus[1] is not None:
        right_in_left = imus[0] @ np.linalg.inv(imus[1])
    else:
        raise LogError(
            f"{named[1]} lacks 'T_cn_cnm1', the transform from cam0; give the camchain of a stereo calibration"
        )
    topics = tuple(str(cam.get("rostopic", "")) for cam in cams)
    return StereoCalibration((models[0], models[1]), right_in_left, imus[0], (topics[0], topics[1]))


def _from_imu(cam: Mapping[str, Any], where: str) -> Array | None:
    """The transform from the Imu to a camera of Kalibr."""
    if "T_cam_imu" in cam:
        return _rigid(cam, "T_cam_imu", where)
    return np.linalg.inv(_rigid(cam, "T_imu_cam", where)) if "T_imu_cam" in cam else None


def _euroc(named: Sequence[tuple[str, Mapping[str, Any]]]) -> StereoCalibration:
    models = [_pinhole(content, where, "distortion_coefficients") for where, content in named]
    left, right = (_rigid(content, "T_BS", where) for where, content in named)
    from_body = np.linalg.inv(left)
    return StereoCalibration((models[0], models[1]), from_body @ right, from_body)


def _ros(named: Sequence[tuple[str, Mapping[str, Any]]]) -> StereoCalibration:
    models = []
    for where, content in named:
        plain = {_ROS_NAMES.get(key, key): value for key, value in content.items()}
        model = _model(plain, where)
        d = plain.get("D", ())
        d = d.get("data", ()) if isinstance(d, Mapping) else d
        models.append(
            CameraModel(
                *_size(plain, where, ("width", "height")), k=numbers(plain, "K", (3, 3), where),
                d=numbers({"D": d}, "D", (-1,), where), r=numbers(plain, "R", (3, 3), where),
                p=numbers(plain, "P", (3, 4), where), model=model,
            )
        )  # fmt: skip
    return StereoCalibration((models[0], models[1]))


# The names of camera_calibration's files and of a CameraInfo printed as YAML.
_ROS_NAMES = {
    "image_width": "width", "image_height": "height", "camera_matrix": "K", "distortion_coefficients": "D",
    "rectification_matrix": "R", "projection_matrix": "P", "k": "K", "d": "D", "r": "R", "p": "P",
}  # fmt: skip

# OpenCV's samples, its calibration tools and others that write with its FileStorage.
_OPENCV_NAMES: dict[str, tuple[tuple[str, str], ...]] = {
    "K": (("M1", "M2"), ("K1", "K2"), ("cameraMatrix1", "cameraMatrix2"), ("camera_matrix_1", "camera_matrix_2"),
          ("left_camera_matrix", "right_camera_matrix"), ("camera_matrix_left", "camera_matrix_right")),
    "D": (("D1", "D2"), ("distCoeffs1", "distCoeffs2"), ("dist_coeffs_1", "dist_coeffs_2"),
          ("left_distortion_coefficients", "right_distortion_coefficients"),
          ("distortion_coefficients_left", "distortion_coefficients_right")),
}  # fmt: skip
_ROTATIONS, _TRANSLATIONS = ("R", "rotation_matrix", "rotation"), ("T", "translation_vector", "translation")


def _opencv(named: Sequence[tuple[str, Mapping[str, Any]]], where: str) -> StereoCalibration:
    singles = [pair for pair in named if "camera_matrix" in pair[1]]
    whole = _merged(named)
    if len(singles) == 2:
        k, d = (
            [numbers(content, name, shape, file) for file, content in singles]
            for name, shape in (("camera_matrix", (3, 3)), ("distortion_coefficients", (-1,)))
        )
        sizes = [_opencv_size(content) for _, content in singles]
    else:
        found = {
            name: next((pair for pair in pairs if set(pair) <= whole.keys()), None)
            for name, pairs in _OPENCV_NAMES.items()
        }
        if found["K"] is None or found["D"] is None:
            raise LogError(f"{where} is not a calibration in a known format; give {_KNOWN}")
        k = [numbers(whole, name, (3, 3), where) for name in found["K"]]
        d = [numbers(whole, name, (-1,), where) for name in found["D"]]
        sizes = [_opencv_size(whole)] * 2
    names = [next((name for name in group if name in whole), group[0]) for group in (_ROTATIONS, _TRANSLATIONS)]
    left_to_right = np.eye(4)
    left_to_right[:3, :3] = numbers(whole, names[0], (3, 3), where)
    left_to_right[:3, 3] = numbers(whole, names[1], (3,), where)
    _check_rigid(left_to_right, names[0], where)
    model = "equidistant" if whole.get("model") == "fisheye" or whole.get("distortion_model") == "equidistant" else ""
    models = []
    for size, matrix, coefficients in zip(sizes, k, d, strict=True):
        name = model or ("rational_polynomial" if coefficients.size >= 8 else "plumb_bob")
        models.append(CameraModel(*size, k=matrix, d=coefficients, r=np.eye(3), p=np.zeros((3, 4)), model=name))
    return StereoCalibration((models[0], models[1]), np.linalg.inv(left_to_right))


def _opencv_size(content: Mapping[str, Any]) -> tuple[int, int]:
    """Width and height of the images, px; 0, 0 where the file does not say."""
    for names in (("image_width", "image_height"), ("width", "height")):
        if set(names) <= content.keys():
            return _size(content, "the calibration", names)
    name = next((name for name in ("imageSize", "image_size") if name in content), None)
    width, height = (0, 0) if name is None else numbers(content, name, (2,), "the calibration")
    return int(width), int(height)


def _pinhole(content: Mapping[str, Any], where: str, coefficients: str) -> CameraModel:
    """A camera of Kalibr or EuRoC."""
    if content.get("camera_model", "pinhole") != "pinhole":
        raise LogError(f"the camera model '{content['camera_model']}' of {where} is not supported, only 'pinhole'")
    fu, fv, cu, cv = numbers(content, "intrinsics", (4,), where)
    width, height = numbers(content, "resolution", (2,), where)
    d = numbers(content, coefficients, (-1,), where) if content.get("distortion_model") != "none" else np.zeros(5)
    k = np.array([[fu, 0, cu], [0, fv, cv], [0, 0, 1]])
    return CameraModel(int(width), int(height), k, d, np.eye(3), np.zeros((3, 4)), _model(content, where, d.size))


def _model(content: Mapping[str, Any], where: str, coefficients: int | None = None) -> str:
    """The lens model by its name in `CameraModel`."""
    given = str(content.get("distortion_model", "plumb_bob"))
    if given not in _MODELS:
        raise LogError(f"the lens model '{given}' of {where} is not supported, only {', '.join(_MODELS)}")
    model = _MODELS[given]
    if coefficients is not None and coefficients not in _COEFFICIENTS[model]:
        raise LogError(f"{where} has {coefficients} distortion coefficients, which do not fit '{given}'")
    return model


def _size(content: Mapping[str, Any], where: str, names: tuple[str, str]) -> tuple[int, int]:
    width, height = (numbers(content, name, (), where) for name in names)
    return int(width), int(height)


def _rigid(content: Mapping[str, Any], name: str, where: str) -> Array:
    """A transform (4, 4)."""
    matrix = numbers(content, name, (4, 4), where)
    _check_rigid(matrix, name, where)
    if not np.allclose(matrix[3], (0, 0, 0, 1), rtol=0, atol=1e-6):
        raise LogError(f"the last row of '{name}' of {where} is {matrix[3].tolist()}, not 0, 0, 0, 1")
    return matrix


def _check_rigid(matrix: Array, name: str, where: str) -> None:
    rotation = matrix[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise LogError(f"'{name}' of {where} is not a rotation; give the calibration as its tool wrote it")


def _mapping(content: Mapping[str, Any], name: str, where: str) -> Mapping[str, Any]:
    found = content[name]
    if not isinstance(found, Mapping):
        raise LogError(f"'{name}' of {where} is not a camera; it must be a mapping of names to values")
    return found


def _merged(named: Sequence[tuple[str, Mapping[str, Any]]]) -> dict[str, Any]:
    return {key: value for _, content in named for key, value in content.items()}
