"""Reads parts of the Katwijk beach traverses (ESA 2015), for `roverflow import katwijk`: LocCam, tilt, Imu and GPS.

Image names end in _0 (left) and _1 (right) after their time. The last three columns of imu.txt are the accelerations of
the inclinometer, whose direction is up. The calibration is a MATLAB file with structs, in mm, of pixels from (1, 1), or
any that `source.calibration` reads. Times have no zone and count as UTC. The PanCam turns on the rover and is left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from resource import RLIMIT_DATA, setrlimit
from typing import Any

import numpy as np
from scipy.io import loadmat
from scipy.spatial.transform import Rotation

from recordings.calibration.formats import StereoCalibration, read_calibration
from recordings.errors import LogError
from recordings.importers.files import from_date, numbers_of, read_bytes, read_rows
from recordings.importers.recording import (
    BASE,
    IMU,
    LEFT,
    RIGHT,
    ImagePair,
    ImportedRecording,
    Logged,
    common_size,
    fix,
    paired,
    raw_models,
)
from recordings.importers.rig import MOUNT, Rig
from recordings.importers.track import upright
from recordings.ros2.to_msg import imu, raw_imu
from recordings.source.transforms import rigid
from stages.data import Array, CameraModel, Transform

GPS = "gps_link"
# The LocCam's left camera on the Imu, whose x axis points back.
CAMERA_ON_IMU = Transform(
    IMU, LEFT, Rotation.from_quat([0.572, 0.572, -0.416, -0.416]).as_matrix(), np.array([-0.382, -0.078, 0.557])
)
GPS_ON_IMU = Transform(IMU, GPS, np.diag([-1.0, -1.0, 1.0]), np.array([0.2209, -0.0515, 1.5785]))
PREFIX = "LocCam_"
MAX_MAT_BYTES = 400 << 20  # of the process that reads a calibration


def read_katwijk(source: Path, rig: Rig, calibration: tuple[Path, ...]) -> ImportedRecording:
    """The part in a folder with LocCam and imu.txt; the rig gives the height of the camera. Raises LogError."""
    if not (source / "LocCam").is_dir():
        raise LogError(f"{source} has no folder LocCam; give the folder of one part of a traverse")
    rig.need("Katwijk", "height")
    notes: list[str] = []
    pairs = _pairs(source / "LocCam", notes)
    read = calibration[0].suffix == ".mat"
    size = common_size(pairs)
    calibrated = _structs(calibration[0], size) if read else read_calibration(calibration)
    base = Transform(BASE, IMU, np.diag([-1.0, -1.0, 1.0]), np.zeros(3)).after(CAMERA_ON_IMU)
    usual = all(getattr(rig, name) in (None, 0.0) for name in MOUNT if name != "height")
    place = np.array([*base.translation[:2], rig.height])
    mounts = [
        Transform(BASE, LEFT, base.rotation, place) if usual else rig.mount,
        CAMERA_ON_IMU.inverse(), GPS_ON_IMU,
    ]  # fmt: skip
    if calibrated.right_in_left is not None:  # else the projections contain the baseline
        mounts.append(rigid(LEFT, RIGHT, calibrated.right_in_left))
    return ImportedRecording(
        raw_models(calibrated, size, calibration), False, pairs, mounts,
        [_sensors(source / "imu.txt"), _places(source / "gps-utm31.txt", notes)], notes=notes,
    )  # fmt: skip


def _pairs(folder: Path, notes: list[str]) -> list[ImagePair]:
    files = [{file.stem[:-2]: file for file in folder.glob(f"[!.]*_{side}.png")} for side in "01"]
    pairs = paired(files, "time", folder, notes)
    return [ImagePair(_time(name[len(PREFIX) :], str(left)), left, right) for name, left, right in pairs]


def _time(text: str, where: str) -> int:
    """A time such as 2015_11_26_12_53_35_149, whose milliseconds may lack their zeros."""
    head, _, milliseconds = text.rpartition("_")
    return from_date(f"{head}_{milliseconds.zfill(3)}", where)


def _structs(path: Path, size: tuple[int, int]) -> StereoCalibration:
    """The calibration in a MATLAB file of structs (toStruct of stereoParameters)."""
    read_bytes(path)  # names a file that cannot be read
    try:
        # A damaged file may end the process of scipy's reader, or fill its memory.
        limit = RLIMIT_DATA, (MAX_MAT_BYTES, MAX_MAT_BYTES)
        with ProcessPoolExecutor(1, get_context("spawn"), setrlimit, limit) as apart:
            found: Any = apart.submit(loadmat, path, simplify_cells=True).result()["stereoParams"]
        models = [_model(found[f"CameraParameters{number}"], size) for number in (1, 2)]
        rotation = np.asarray(found["RotationOfCamera2"], np.float64).reshape(3, 3)
        shift = np.asarray(found["TranslationOfCamera2"], np.float64).reshape(3) / 1000
    except Exception as error:  # scipy raises many kinds
        raise LogError(
            f"{path} has no struct 'stereoParams' of numbers ({error}); save toStruct(stereoParams) with MATLAB, or "
            "give a calibration of OpenCV, Kalibr or ROS"
        ) from error
    # Copies differ in whether the shift is of points or of the camera. The right camera is to the right.
    whole = np.eye(4)
    whole[:3, :3] = rotation
    whole[:3, 3] = shift if shift[0] > 0 else -rotation @ shift
    return StereoCalibration((models[0], models[1]), whole)


def _model(camera: Any, size: tuple[int, int]) -> CameraModel:
    k = np.array(camera["IntrinsicMatrixInternal"], np.float64).reshape(3, 3)
    k[:2, 2] -= 1.0  # MATLAB's first pixel is (1, 1)
    radial, tangential = (np.ravel(camera[f"{name}Distortion"]) for name in ("Radial", "Tangential"))
    d = np.array([*radial[:2], *tangential, *radial[2:]], np.float64)
    return CameraModel(*size, k=k, d=d, r=np.eye(3), p=np.zeros((3, 4)))


def _sensors(path: Path) -> Iterator[Logged]:
    """The tilt by the inclinometer, and accelerations, m/s^2, and rates, rad/s, of the Imu."""
    for stamp, values in _table(path, 9):
        if np.any(values[6:]):
            yield stamp, "/inclinometer", imu(stamp, IMU, upright(values[6:]))
        yield stamp, "/imu/data_raw", raw_imu(stamp, IMU, values[3:6], values[:3])


def _places(path: Path, notes: list[str]) -> list[Logged]:
    """The places by GPS: latitude and longitude, despite the name of the file, and altitude."""
    if not path.exists():
        return []
    table = list(_table(path, 3))
    if any(not (abs(values[0]) <= 90 and abs(values[1]) <= 180) for _, values in table):
        notes.append(f"{path.name} does not contain degrees; its positions are left out")
        return []
    return [fix(stamp, GPS, *values[:3].tolist()) for stamp, values in table]


def _table(path: Path, columns: int) -> Iterator[tuple[int, Array]]:
    """Stamp and numbers of each line that begins with a time, in the order of stamps."""
    rows = [(where, row) for where, row in read_rows(path, 1) if row[0][0].isdigit()]
    found = []
    for where, row in rows:
        if len(row) < columns + 1:
            raise LogError(f"{where} has {len(row)} columns, but at least {columns + 1} are needed; download it again")
        found.append((_time(row[0], where), numbers_of(row[1 : columns + 1], where)))
    if not found:
        raise LogError(f"{path} contains no line that begins with a time; download it again")
    yield from sorted(found, key=lambda item: item[0])
