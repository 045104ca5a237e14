"""Reads sequences of KITTI's odometry benchmark: rectified images, times since the start, and maybe true poses.

The files contain no tilt. The rig file gives the camera's attitude in the first frame. From there the true poses turn
it; without poses the car is taken as level, with a note. The true poses are those of the first camera, y down.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from flow.contracts import counted
from recordings.errors import LogError
from recordings.importers.files import from_seconds, numbers_of, read_lines
from recordings.importers.recording import (
    BASE,
    FIRST_STAMP,
    LEFT,
    ImagePair,
    ImportedRecording,
    Logged,
    common_size,
    note_frames_without_pose,
    tilts_of,
)
from recordings.importers.rig import Rig
from recordings.importers.track import Track
from recordings.ros2.to_msg import imu
from recordings.source.transforms import orthonormal
from stages.data import Array, StereoCamera, Transform

MAX_INTERVAL = 60.0  # s; frames that are farther apart have times in another unit


def read_odometry(source: Path, rig: Rig, color: bool) -> ImportedRecording:
    """The sequence in a folder with image_0 and so on, calib.txt and times.txt; poses in ../../poses/NN.txt."""
    rig.need("KITTI's odometry benchmark", "height", "pitch_down")
    mount, cameras = rig.mount, (2, 3) if color else (0, 1)
    assert mount is not None
    stamps = [from_seconds(line, where, FIRST_STAMP) for where, line in read_lines(source / "times.txt", listed=True)]
    if len(stamps) > 1 and (interval := float(np.median(np.diff(stamps))) / 1e9) > MAX_INTERVAL:
        raise LogError(f"{source / 'times.txt'} has frames {interval:g} s apart (median); write times in seconds")
    folders = [source / f"image_{camera}" for camera in cameras]
    listed = [
        ImagePair(stamp, folders[0] / f"{number:06d}.png", folders[1] / f"{number:06d}.png")
        for number, stamp in enumerate(stamps)
    ]
    notes: list[str] = []
    tilts: Iterable[Logged]
    pairs = existing(folders, listed, "times.txt", notes)
    if not pairs:
        raise LogError(f"{source} contains no pair of images in image_{cameras[0]} and image_{cameras[1]}")
    projections = [_projections(source / "calib.txt")[camera] for camera in cameras]
    camera, shift = stereo_camera(projections, common_size(pairs))
    sequence = source.resolve()
    places = sequence.parents[1] / "poses" / f"{sequence.name}.txt", source / "poses.txt"
    poses = next((path for path in places if path.exists()), None)
    if poses is None:
        notes.append("the files contain neither poses nor tilt: the car is assumed level in every frame")
        level = np.array([0.0, 0.0, 0.0, 1.0])
        track, tilts = None, ((stamp, "/inclinometer", imu(stamp, BASE, level)) for stamp in stamps)
    else:
        notes.append(f"the tilt is that of the rig file, rotated by the true poses in {poses.name}")
        track = _track(poses, stamps, mount, shift, notes)
        note_frames_without_pose(track, pairs, poses.name, notes)
        tilts = tilts_of(track, [pair.stamp for pair in pairs])
    return ImportedRecording.of_rectified(camera, pairs, mount, sensors=[tilts], truth=track, notes=notes)


def existing(folders: list[Path], listed: list[ImagePair], file: str, notes: list[str]) -> list[ImagePair]:
    """The pairs that have both images. Notes count the others that `file` lists, and the images that it does not."""
    names = {path.name for folder in folders for path in folder.glob("[!.]*.png")}
    if unlisted := sorted(names.difference(pair.left.name for pair in listed)):
        notes.append(f"{file} has no line for {counted(len(unlisted), 'image')}, first: {unlisted[0]}")
    pairs = [pair for pair in listed if pair.left.exists() and pair.right.exists()]
    if len(pairs) < len(listed):
        notes.append(f"{file} lists {counted(len(listed) - len(pairs), 'pair')} without one of the images")
    return pairs


def stereo_camera(projections: list[Array], size: tuple[int, int]) -> tuple[StereoCamera, Array]:
    """The rectified camera of two projections (3, 4), and (3,) m from the first camera's place to the left one's."""
    left, right = projections
    if not all(projection[0, 0] > 0 and projection[1, 1] > 0 and projection[2, 2] > 0 for projection in projections):
        raise LogError("KITTI's calibration has a projection without a focal length; download it again")
    shifts = [np.linalg.solve(projection[:, :3], projection[:, 3]) for projection in projections]
    baseline = float(shifts[0][0] - shifts[1][0])
    if not baseline > 0:
        raise LogError(f"KITTI's calibration has a baseline of {baseline:g} m; download it again")
    camera = StereoCamera(
        fx=float(left[0, 0]), fy=float(left[1, 1]), cx=float(left[0, 2]), cy=float(left[1, 2]), baseline=baseline,
        width=size[0], height=size[1], cx_right=float(right[0, 2]), frame_id=LEFT,
    )  # fmt: skip
    return camera, shifts[0]


def _projections(path: Path) -> list[Array]:
    """P0 to P3; some copies of the file have them without their names."""
    found = []
    for where, line in read_lines(path):
        key, colon, values = line.rpartition(":")
        numbers = numbers_of(values.split(), where)
        if (not colon or key.startswith("P")) and numbers.size == 12:
            found.append(numbers.reshape(3, 4))
    if len(found) < 4:
        raise LogError(f"{path} has {len(found)} projections of 12 numbers, not P0 to P3; download it again")
    return found


def _track(path: Path, stamps: list[int], mount: Transform, shift: Array, notes: list[str]) -> Track:
    """The poses of the left camera, in a world in which base_link is level in the first frame."""
    poses, lines = [], list(read_lines(path, listed=True))
    if len(lines) > len(stamps):
        notes.append(
            f"{path.name} has {counted(len(lines), 'pose')} for {counted(len(stamps), 'time')}; the last are left out"
        )
    for (where, line), stamp in zip(lines, stamps, strict=False):
        row = numbers_of(line.split(), where)
        if row.size != 12:
            raise LogError(f"{where} has {row.size} numbers, not 12; download it again")
        pose = row.reshape(3, 4)
        place = mount.rotation @ (pose[:, 3] - pose[:, :3] @ shift)
        turn = Rotation.from_matrix(mount.rotation @ orthonormal(pose[:, :3], where))
        poses.append((stamp, place, turn))
    return Track.of(LEFT, poses, path)
