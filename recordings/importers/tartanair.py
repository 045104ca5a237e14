"""Reads trajectories of TartanAir and TartanGround, for `roverflow import tartanair`.

The images are rectified, of cameras with a field of view of 90 degrees, 0.25 m apart, 10 a second. Poses have x north,
y east, z down, of a body x forward, y right, z down. They give the tilt, as the sign of the simulated accelerations
differs between the sets. A depth image has one little-endian float32 in the four bytes of each pixel.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tokenize import TokenError

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from recordings.errors import LogError
from recordings.importers.files import in_ros_time, numbers_of, of_size, read_bytes, read_rows, rotation_of
from recordings.importers.recording import (
    FIRST_STAMP,
    LEFT,
    ImagePair,
    ImportedRecording,
    Logged,
    common_size,
    note_frames_without_pose,
    paired,
    tilts_of,
)
from recordings.importers.rig import Rig
from recordings.importers.track import Track
from recordings.ros2.to_msg import disparity_image, exact_disparity
from recordings.source.transforms import BODY_FROM_OPTICAL
from stages.data import Array, StereoCamera

# Names of the left and right camera, the second of TartanAir's first version.
CAMERAS = (("lcam_front", "rcam_front"), ("left", "right"))
PERIOD_NS, BASELINE = 100_000_000, 0.25
MAX_DEPTH = 10_000.0  # m; the sky is farther
_DOWN = np.diag([1.0, -1.0, -1.0])  # from x, y and z down to x, y and z up, and back


def read_tartanair(source: Path, rig: Rig) -> ImportedRecording:
    """The trajectory in a folder such as P000. rig: where base_link is, if known. Raises LogError."""
    named = next((names for names in CAMERAS if (source / f"image_{names[0]}").is_dir()), None)
    if named is None:
        raise LogError(f"{source} has no folder image_{CAMERAS[0][0]}; give the folder of one trajectory, such as P000")
    left = named[0]
    notes = ["the tilt is derived from the poses, as the data set has no tilt sensor"]
    files = [
        {int(number): file for file in source.glob(f"image_{name}/*_{name}.png")
         if (number := file.name.partition("_")[0]).isdecimal()}
        for name in named
    ]  # fmt: skip
    found = paired(files, "number", source, notes)
    pairs = [
        ImagePair(in_ros_time(FIRST_STAMP + number * PERIOD_NS, str(number), str(pair[0])), *pair)
        for number, *pair in found
    ]
    track = _track(source / f"pose_{left}.txt")
    note_frames_without_pose(track, pairs, f"pose_{left}.txt", notes)
    size = common_size(pairs)
    camera = rig.camera(size, size[0] / 2, BASELINE)
    depths = [next(iter(source.glob(f"depth_{left}/{pair.left.stem}_depth.*")), None) for pair in pairs]
    return ImportedRecording.of_rectified(
        camera, pairs, rig.mount, sensors=[tilts_of(track, [pair.stamp for pair in pairs])], truth=track, notes=notes,
        more=lambda number: _truth(pairs[number].stamp, camera, depths[number]),
    )  # fmt: skip


def _track(path: Path) -> Track:
    """The poses of the left camera, one a line."""
    poses = []
    for number, (where, row) in enumerate(read_rows(path, 7, listed=True)):
        values = numbers_of(row[:7], where)
        turn = _DOWN @ rotation_of(values[3:], where).as_matrix() @ _DOWN @ BODY_FROM_OPTICAL
        poses.append((FIRST_STAMP + number * PERIOD_NS, _DOWN @ values[:3], Rotation.from_matrix(turn)))
    return Track.of(LEFT, poses, path)


def _truth(stamp: int, camera: StereoCamera, path: Path | None) -> Iterator[Logged]:
    """The true disparity by a depth image."""
    if path is None:
        return
    depth = of_size(_depth(path), camera, path)
    known = np.isfinite(depth) & (depth > 0) & (depth < MAX_DEPTH)
    pixels = np.full(depth.shape, np.nan, np.float32)
    pixels[known] = camera.fx * camera.baseline / depth[known].astype(np.float64)
    yield stamp, "/truth/disparity", disparity_image(exact_disparity(stamp, pixels, camera))


def _depth(path: Path) -> Array:
    """(H, W) float32, m, of a depth image or, in TartanAir's first version, of a numpy file."""
    try:
        if path.suffix == ".npy":
            depth = np.asarray(np.load(path, allow_pickle=False), np.float32)
            if depth.ndim != 2:
                raise ValueError(f"{depth.ndim} dimensions")
            return depth
        content = cv2.imdecode(np.frombuffer(read_bytes(path), np.uint8), cv2.IMREAD_UNCHANGED)
        return np.ascontiguousarray(content).view("<f4")[:, :, 0]
    except (ValueError, IndexError, TypeError, EOFError, OSError, SyntaxError, TokenError, cv2.error) as error:
        raise LogError(f"{path} is not a depth image of four bytes a pixel; download it again") from error
