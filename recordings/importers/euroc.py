"""Reads recordings in EuRoC's (ASL) layout, for `roverflow import euroc`: EuRoC, TUM-VI and all that is written so.

A folder `mav0` contains cam0 and cam1 (data.csv, data/, sensor.yaml), imu0 (rates, then accelerations) and maybe the
truth. T_BS is the pose of a sensor in the body, which is the Imu. Images are paired by stamp, as lists may name files
that are missing. Up is not in the files; a run estimates it from the Imu.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from flow.contracts import counted
from recordings.calibration.formats import read_calibration
from recordings.calibration.yaml_files import numbers, read_yaml
from recordings.errors import LogError
from recordings.importers.files import firsts, nanoseconds, numbers_of, read_rows, rotation_of
from recordings.importers.pairing import SUFFIXES
from recordings.importers.recording import (
    IMU,
    LEFT,
    RIGHT,
    ImagePair,
    ImportedRecording,
    Logged,
    common_size,
    paired,
    raw_models,
)
from recordings.importers.rig import Rig
from recordings.importers.track import Track
from recordings.ros2.to_msg import raw_imu
from recordings.source.transforms import rigid

CAMERAS = ("cam0", "cam1")  # left and right
# Relative to mav0. Position, then quaternion w, x, y, z, of the body in a world with z up.
TRUTHS = ("state_groundtruth_estimate0", "mocap0", "gt")


def read_euroc(source: Path, rig: Rig, calibration: Sequence[Path] = ()) -> ImportedRecording:
    """The recording in a folder that contains mav0, or mav0 itself.

    calibration: files instead of cam0/sensor.yaml and cam1/sensor.yaml; rig: where base_link is, if known. Raises
    LogError.
    """
    folder = source / "mav0" if (source / "mav0").is_dir() else source
    if not (folder / "cam0").is_dir():
        raise LogError(f"{source} contains no mav0 with cam0, cam1 and imu0; give the folder of one sequence")
    if not calibration:
        calibration = [folder / camera / "sensor.yaml" for camera in CAMERAS]
        if not calibration[0].exists():
            raise LogError(f"there is no {calibration[0]}; give --calibration, such as Kalibr's camchain.yaml")
    notes = [
        f"{path.name} of {path.parent.name} begins with %YAML:1.0, which is not YAML; the line is ignored"
        for path in calibration if path.is_file() and path.read_bytes().startswith(b"%YAML:")
    ]  # fmt: skip
    calibrated = read_calibration(calibration)
    if calibrated.camera_from_imu is None or calibrated.right_in_left is None:
        raise LogError(f"{calibration[0]} lacks the transform between Imu and camera; give the file of imu and cameras")
    if calibrated.baseline < 0:
        raise LogError("cam1 is the left camera by the calibration; exchange the names of cam0 and cam1")
    camera_from_imu = calibrated.camera_from_imu @ _imu_in_body(folder / "imu0" / "sensor.yaml")
    mounts = [rig.mount, rigid(LEFT, RIGHT, calibrated.right_in_left), rigid(LEFT, IMU, camera_from_imu)]
    pairs = _pairs(folder, notes)
    truth = next((path for name in TRUTHS if (path := folder / name / "data.csv").exists()), None)
    return ImportedRecording(
        raw_models(calibrated, common_size(pairs), calibration), False, pairs,
        mounts, [_imu(folder / "imu0" / "data.csv")],
        None if truth is None else _track(truth), true_tilt=True, notes=notes,
    )  # fmt: skip


def _pairs(folder: Path, notes: list[str]) -> list[ImagePair]:
    """The pairs of equal stamps of which both files exist; notes about the others."""
    found: list[dict[int, Path]] = []
    for camera in CAMERAS:
        data, table = folder / camera / "data", folder / camera / "data.csv"
        rows = [(nanoseconds(row[0], where), data / row[1]) for where, row in read_rows(table, 2, ",")]
        listed = firsts(rows, "stamp", f"{camera}/data.csv", notes)
        files = set(data.glob("[!.]*"))  # any name may be listed, also one that no file can have
        there = {stamp: path for stamp, path in listed.items() if path in files}
        if not there:
            raise LogError(f"{data} contains none of the {counted(len(listed), 'image')} that {table} lists")
        if unlisted := sorted(path.name for path in files - {path for _, path in rows} if path.suffix in SUFFIXES):
            notes.append(
                f"{camera}/data.csv lacks {counted(len(unlisted), 'image')} of {camera}/data: {_some(unlisted)}"
            )
        if missing := [path.name for stamp, path in listed.items() if stamp not in there]:
            lists = f"{camera}/data.csv lists {counted(len(missing), 'image')}"
            notes.append(f"{lists} that {camera}/data lacks: {_some(missing)}")
        found.append(there)
    return [ImagePair(*pair) for pair in paired(found, "stamp", folder, notes)]


def _some(names: list[str]) -> str:
    return f"{names[0]}{' and others' if len(names) > 1 else ''}"


def _imu(path: Path) -> Iterator[Logged]:
    """Rates, rad/s, and accelerations, m/s^2."""
    samples = [(nanoseconds(row[0], where), where, row[1:7]) for where, row in read_rows(path, 7, ",")]
    if not samples:
        raise LogError(f"{path} contains no reading; download it again")
    for stamp, where, row in sorted(samples, key=lambda sample: sample[0]):
        values = numbers_of(row, where)
        yield stamp, "/imu/data_raw", raw_imu(stamp, IMU, values[:3], values[3:])


def _imu_in_body(path: Path) -> np.ndarray:
    """The pose of the Imu in the body: 1, unless its own file has another."""
    content = read_yaml(path) if path.exists() else {}
    return numbers(content, "T_BS", (4, 4), str(path)) if "T_BS" in content else np.eye(4)


def _track(path: Path) -> Track:
    """The poses of the body."""
    poses = []
    for where, row in read_rows(path, 8, ","):
        values = numbers_of(row[1:8], where)
        poses.append((nanoseconds(row[0], where), values[:3], rotation_of(np.roll(values[3:], -1), where)))
    return Track.of(IMU, poses, path)
