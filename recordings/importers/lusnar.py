"""Reads scenes of LuSNAR, for `roverflow import lusnar`: rectified images and the poses of the rover.

Images have their stamps as names. The axes of the rover's body and of the world are not in the files, and neither is
the mount of the camera: the rig file says them. base_link is the body of the poses, which give the tilt.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from recordings.errors import LogError
from recordings.importers.files import nanoseconds, numbers_of, read_lines, rotation_of
from recordings.importers.recording import (
    BASE,
    ImagePair,
    ImportedRecording,
    common_size,
    note_frames_without_pose,
    paired,
    tilts_of,
)
from recordings.importers.rig import AXES, Rig
from recordings.importers.track import Track

WIDTH, FOCAL, BASELINE = 1024, 610.17784, 0.310  # px, px, m
POSES = "Rover_pose.txt"


def read_lusnar(source: Path, rig: Rig) -> ImportedRecording:
    """The scene in a folder with image1, image2 and Rover_pose.txt. Raises LogError."""
    folders = [source / name / "RGB" for name in ("image1", "image2")]
    if not folders[0].is_dir():
        raise LogError(f"{source} has no folder image1/RGB; give the folder of one scene")
    rig.need("LuSNAR", "height", "pitch_down", *AXES)
    files = [{file.name: file for file in folder.glob("[!.]*.png")} for folder in folders]
    notes = ["the tilt is derived from the poses, as the data set has no tilt sensor"]
    found = paired(files, "stamp", source, notes)
    pairs = [ImagePair(nanoseconds(left.stem, str(left)), left, right) for _, left, right in found]
    pairs.sort(key=lambda pair: pair.stamp)
    size, track = common_size(pairs), _track(source / POSES, rig)
    note_frames_without_pose(track, pairs, POSES, notes)
    camera = rig.camera(size, FOCAL * size[0] / WIDTH, BASELINE)
    tilts = [tilts_of(track, track.stamps.tolist())]
    return ImportedRecording.of_rectified(camera, pairs, rig.mount, sensors=tilts, truth=track, notes=notes)


def _track(path: Path, rig: Rig) -> Track:
    """The poses of the body: stamp, position, quaternion w, x, y, z, and more."""
    upright, axes = rig.poses
    poses = []
    for where, line in read_lines(path):
        row = line.replace(",", " ").split()
        if len(row) < 8:
            raise LogError(f"{where} has {len(row)} columns, but at least 8 are needed; download it again")
        values = numbers_of(row[1:8], where)
        turn = upright @ rotation_of(np.roll(values[3:], -1), where).as_matrix() @ axes
        poses.append((nanoseconds(row[0], where), upright @ values[:3], Rotation.from_matrix(turn)))
    return Track.of(BASE, poses, path)
