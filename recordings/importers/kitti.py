"""Reads raw drives of KITTI, for `roverflow import kitti`: images, calibration, and the attitude and place of the INS.

A drive is synchronised and rectified (`_sync`) or not (`_extract`), which the size of its images says. The INS (oxts)
gives roll, pitch and yaw, Euler angles of x forward, y left, z up: its orientation is the tilt, its place the truth.
Both images of a number get the left one's stamp, as they were exposed together. Times without a zone count as UTC.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from flow.contracts import counted
from recordings.errors import LogError
from recordings.importers.files import from_date, numbers_of, read_lines
from recordings.importers.kitti_odometry import existing, read_odometry, stereo_camera
from recordings.importers.recording import (
    BASE,
    IMU,
    LEFT,
    RIGHT,
    ImagePair,
    ImportedRecording,
    Logged,
    beside,
    common_size,
    fix,
    rectified_models,
)
from recordings.importers.rig import Rig
from recordings.importers.track import Track, mercator
from recordings.ros2.to_msg import imu
from recordings.source.transforms import rigid
from stages.data import Array, CameraModel, Transform

IMU_HEIGHT = 0.93  # m above the road, by KITTI's description of its car
CALIBRATIONS = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt")


def read_kitti(source: Path, rig: Rig, color: bool = False) -> ImportedRecording:
    """The drive in a folder with image_00 and so on and oxts, or the odometry sequence in one with calib.txt.

    rig: where base_link is, if not on the road below the Imu of KITTI's car; color: images of the colour cameras.
    Raises LogError.
    """
    if (source / "calib.txt").exists():
        return read_odometry(source, rig, color)
    left, right = ("02", "03") if color else ("00", "01")
    if not (source / f"image_{left}").is_dir():
        raise LogError(
            f"{source} has no folder image_{left}; give the folder of one drive, or of one odometry sequence"
        )
    home = source if (source / CALIBRATIONS[0]).exists() else source.resolve().parent
    cameras, velo_to_cam, imu_to_velo = (_calibration(home / name) for name in CALIBRATIONS)
    notes: list[str] = []
    folders = [source / f"image_{camera}" / "data" for camera in (left, right)]
    listed = [
        ImagePair(from_date(line, where), folders[0] / f"{number:010d}.png", folders[1] / f"{number:010d}.png")
        for number, (where, line) in enumerate(read_lines(source / f"image_{left}" / "timestamps.txt", listed=True))
    ]
    pairs = sorted(existing(folders, listed, "timestamps.txt", notes), key=lambda pair: pair.stamp)
    camera_from_imu = _rigid(velo_to_cam, "R", "T") @ _rigid(imu_to_velo, "R", "T")
    size = common_size(pairs)
    rectified = size == tuple(_entry(cameras, f"S_rect_{left}", 2).astype(int))
    read = _rectified if rectified else _raw
    models, right_in_left, left_from_first = read(cameras, left, right)
    to_imu = rigid(LEFT, IMU, left_from_first @ camera_from_imu)
    base = rig.mount
    if base is None:
        base = Transform(BASE, IMU, np.eye(3), np.array([0.0, 0.0, IMU_HEIGHT])).after(to_imu.inverse())
        notes.append(f"base_link is {IMU_HEIGHT} m below the Imu, as on KITTI's car; the rig file can change this")
    stamps, table = _readings(source / "oxts", notes)
    track = _track(stamps, table, source / "oxts")
    mounts, sensors = [base, right_in_left, to_imu], [_tilts(track), _fixes(stamps, table)]
    return ImportedRecording(models, rectified, pairs, mounts, sensors, track, notes=notes)


def _calibration(path: Path) -> dict[str, Array]:
    """The numbers of each `key: numbers` in a file; other entries, such as a time, are left out."""
    found = {}
    for where, line in read_lines(path):
        key, _, values = line.partition(":")
        try:
            found[key] = numbers_of(values.split(), where)
        except LogError:
            continue
    return found


def _entry(values: dict[str, Array], name: str, *shape: int) -> Array:
    if name not in values or values[name].size != int(np.prod(shape)):
        raise LogError(f"KITTI's calibration lacks '{name}' with {int(np.prod(shape))} numbers; download it again")
    return values[name].reshape(shape)


def _rigid(values: dict[str, Array], rotation: str, translation: str) -> Array:
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = _entry(values, rotation, 3, 3), _entry(values, translation, 3)
    return whole


def _rectified(values: dict[str, Array], left: str, right: str) -> tuple[Any, Transform, Array]:
    """Models, left <- right camera, and the (4, 4) transform from the unrectified first camera to the left one."""
    projections = [_entry(values, f"P_rect_{number}", 3, 4) for number in (left, right)]
    width, height = _entry(values, f"S_rect_{left}", 2)
    camera, shift = stereo_camera(projections, (int(width), int(height)))
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = _entry(values, "R_rect_00", 3, 3), shift
    return rectified_models(camera), beside(camera), whole


def _raw(values: dict[str, Array], left: str, right: str) -> tuple[Any, Transform, Array]:
    """The same for images that are not rectified."""
    models = []
    for number in (left, right):
        k, (width, height) = _entry(values, f"K_{number}", 3, 3), _entry(values, f"S_{number}", 2)
        p, d = np.column_stack([k, np.zeros(3)]), _entry(values, f"D_{number}", 5)
        models.append(CameraModel(int(width), int(height), k=k, d=d, r=np.eye(3), p=p))
    first, second = (_rigid(values, f"R_{number}", f"T_{number}") for number in (left, right))
    return tuple(models), rigid(LEFT, RIGHT, first @ np.linalg.inv(second)), first


def _readings(oxts: Path, notes: list[str]) -> tuple[list[int], Array]:
    """Stamps, and (n, 6) latitude and longitude, deg, altitude, m, roll, pitch and yaw, rad, of the INS."""
    rows, stamps = [], []
    lines = list(read_lines(oxts / "timestamps.txt", listed=True))
    for number, (where, line) in enumerate(lines):
        if (path := oxts / "data" / f"{number:010d}.txt").exists():
            stamps.append(from_date(line, where))
            rows.append(next((numbers_of(text.split()[:6], place) for place, text in read_lines(path)), np.zeros(0)))
            if rows[-1].size < 6:
                raise LogError(f"{path} has fewer than 6 numbers; download it again")
    if not rows:
        raise LogError(f"{oxts} contains no readings of the Imu; download the oxts folder of the drive")
    if len(rows) < len(lines):
        notes.append(f"oxts/timestamps.txt lists {counted(len(lines) - len(rows), 'reading')} without a file")
    return stamps, np.array(rows)


def _track(stamps: list[int], table: Array, where: Path) -> Track:
    """The poses of the Imu: east, north and up of the first place."""
    places = np.column_stack([mercator(table[:, 0], table[:, 1]), table[:, 2]])
    turns = Rotation.from_euler("ZYX", table[:, 5:2:-1])
    return Track.of(IMU, list(zip(stamps, places, turns, strict=True)), where)


def _tilts(track: Track) -> Iterator[Logged]:
    for stamp, turn in zip(track.stamps.tolist(), track.rotations.as_quat(), strict=True):
        yield stamp, "/imu/data", imu(stamp, IMU, turn)


def _fixes(stamps: list[int], table: Array) -> Iterator[Logged]:
    for stamp, row in sorted(zip(stamps, table.tolist(), strict=True)):
        yield fix(stamp, IMU, *row[:3])
