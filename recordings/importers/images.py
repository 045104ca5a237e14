"""Makes a log from stereo image files, rectified or with their calibration, and a known camera attitude.

The log contains what a rover's own log would: calibration, the mount of the camera, and an inclinometer. The rover
stands level and the camera is mounted on it pitched and rolled. So the attitude is in /tf_static, or on /tf if each
pair has its own, and the inclinometer, fixed to the rover, reads level.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from flow.contracts import counted
from flow.parameters import Checked, is_required, parameter
from recordings.calibration.formats import read_calibration
from recordings.calibration.yaml_files import read_yaml
from recordings.errors import LogError
from recordings.importers.attitudes import read_attitudes
from recordings.importers.files import image_size, read_pixels
from recordings.importers.recording import (
    BASE,
    FIRST_STAMP,
    IMU,
    LEFT,
    RIGHT,
    ImagePair,
    ImportedRecording,
    Logged,
    beside,
    image_message,
    raw_models,
    rectified_models,
    write_recording,
)
from recordings.importers.rig import Rig
from recordings.ros2.cdr import LAST_STAMP
from recordings.ros2.to_msg import imu, transform_message
from recordings.source.transforms import rigid
from stages.data import CameraModel, StereoCamera, StereoFrame, Transform

MAX_HEIGHT = 1e9  # m, as in a rig file
TILT_OFFSET_NS = 10_000_000  # before and after each pair there is a tilt, so that one is on both sides of it
_POSITIVE: dict[str, Any] = {"low": 1e-6, "high": 1e9}
_ANY: dict[str, Any] = {"low": -1e9, "high": 1e9}


@dataclass(frozen=True, kw_only=True)
class ImageCalibration(Checked):
    """The calibration file of `import_images`."""

    fx: float = parameter(MISSING, "focal length", unit="px", **_POSITIVE)
    cx: float = parameter(MISSING, "principal point of the left image", unit="px", **_ANY)
    cy: float = parameter(MISSING, "principal point", unit="px", **_ANY)
    baseline: float = parameter(MISSING, "distance of the cameras", unit="m", **_POSITIVE)
    fy: float | None = parameter(None, "vertical focal length, by default fx", unit="px", **_POSITIVE)
    cx_right: float | None = parameter(None, "principal point of the right image, by default cx", unit="px", **_ANY)
    width: float | None = parameter(None, "width of the images", unit="px", **_POSITIVE)
    height: float | None = parameter(None, "height of the images", unit="px", **_POSITIVE)


def import_images(
    left: Sequence[Path],
    right: Sequence[Path],
    calibration: Path | Sequence[Path] | Mapping[str, Any],
    out: Path,
    *,
    pitch_down: float,
    roll: float = 0.0,
    height: float,
    rate: float = 1.0,
    attitudes: Path | None = None,
    progress: Callable[[int], None] = lambda done: None,
    report: Callable[[str], None] = lambda sentence: None,
) -> tuple[int, list[str]]:
    """Write image pairs as a log. The first pair must fit the calibration; later ones that do not are left out.

    Parameters
    ----------
    left, right : sequence of Path
        Image files, in pairs.
    calibration : Path, mapping or sequence of Path
        Of rectified images: YAML file or mapping with fx, cx, cy (px) and baseline (m); optionally fy, cx_right, width,
        height. Else one file or more of OpenCV, Kalibr or ROS.
    out : Path
        The log.
    pitch_down : float
        Angle of the camera below the horizon, deg.
    roll : float
        Rotation about its line of sight, deg, right side down positive.
    height : float
        Height of the left camera above the ground, m.
    rate : float
        Pairs per second in the log.
    attitudes : Path, optional
        CSV file with an attitude of the camera for each pair, in place of pitch_down and roll: columns name (of the
        left image) or stamp (ns), pitch_down and maybe roll and yaw (to the left), deg.
    progress : callable
        Called with the pairs written so far.
    report : callable
        Called with a sentence if there is the unfinished log of an interrupted import.

    Returns
    -------
    tuple[int, list[str]]
        The number of frames, and notes about what is left out.

    Raises
    ------
    LogError
        If the calibration, the attitudes or the first pair cannot be used.
    """
    if len(left) != len(right) or not left:
        raise LogError(f"{len(left)} left and {len(right)} right images are not pairs; give equal numbers")
    if not 0 < height <= MAX_HEIGHT:
        raise LogError(f"the camera's height must be positive and at most {MAX_HEIGHT:g} m, not {height:g} m")
    if not 0 < rate <= 1e9 or FIRST_STAMP + (len(left) + 1) * 1e9 / rate >= LAST_STAMP:
        pairs = counted(len(left), "pair")
        raise LogError(f"the rate of {pairs} must be above 0 and at most 1e9 Hz, not {rate:g}; stamps end in 2038")
    if attitudes is not None and roll:
        raise LogError(f"a roll of {roll:g} degrees cannot be combined with {attitudes}; add a column 'roll' to it")
    if not abs(pitch_down) <= 90 or not abs(roll) <= 180:
        raise LogError(
            f"a pitch of {pitch_down} and a roll of {roll} degrees are impossible; give at most 90 and 180 degrees"
        )
    period = round(1e9 / rate)
    rig = Rig(height=height, pitch_down=math.radians(pitch_down), roll=math.radians(roll))
    files = [calibration] if isinstance(calibration, Path) else calibration
    own = {known.name for known in fields(ImageCalibration)} - {"width", "height"}  # which other formats also have
    if isinstance(files, Mapping) or (len(files) == 1 and read_yaml(files[0]).keys() & own):
        values = _calibration(files if isinstance(files, Mapping) else files[0])
        camera = read_frame(0, (left[0], right[0]), values).camera
        first_size, rectified, cameras = not {"width", "height"} <= values.keys(), True, rectified_models(camera)
        beside_it: Transform | None = beside(camera)
    else:
        rectified, (cameras, beside_it, first_size) = False, _raw(files, (left[0], right[0]))
    numbered = enumerate(zip(left, right, strict=True))
    paired = [ImagePair(FIRST_STAMP + number * period, *pair) for number, pair in numbered]
    moving, notes = None, list[str]()
    if attitudes is not None:
        paired, moving = read_attitudes(attitudes, paired, rig, notes)
    recording = standing(paired, cameras, beside_it, rig, moving)
    whole = replace(recording, rectified=rectified, first_size=first_size, notes=notes)
    return write_recording(whole, out, progress, report)


def standing(
    pairs: Sequence[ImagePair],
    cameras: tuple[CameraModel, CameraModel],
    right: Transform | None,
    rig: Rig,
    moving: Sequence[Transform] | None = None,
) -> ImportedRecording:
    """The recording of a rectified pair of cameras on a rover that stands level.

    right: left camera <- right camera, None if the projections contain it; moving: the mount at each pair, else it is
    that of the rig.
    """
    stamps = [pair.stamp for pair in pairs]
    offset = min([TILT_OFFSET_NS, stamps[0] // 2, LAST_STAMP - 1 - stamps[-1], *(np.diff(stamps) // 4).tolist()])
    level, sensors = Transform(BASE, IMU, np.eye(3), np.zeros(3)), [_level_tilts(stamps, offset)]
    if moving is None:
        return ImportedRecording(cameras, True, pairs, [rig.mount, right, level], sensors)
    turns = ((stamp, "/tf", transform_message([(mount, stamp)])) for stamp, mount in zip(stamps, moving, strict=True))
    return ImportedRecording(cameras, True, pairs, [right, level], [*sensors, turns])


def _raw(
    files: Sequence[Path], pair: tuple[Path, Path]
) -> tuple[tuple[CameraModel, CameraModel], Transform | None, bool]:
    """The cameras of images before rectification, left <- right camera, and whether their size is that of the pair.

    The transform is None if the projections contain it. Raises LogError, also for a pair that does not fit.
    """
    calibrated = read_calibration(files)
    cameras = raw_models(calibrated, image_size(pair[0]), files)
    for path, camera in zip(pair, cameras, strict=True):
        image_message(FIRST_STAMP, LEFT, path, camera)
    moved = calibrated.right_in_left
    return cameras, None if moved is None else rigid(LEFT, RIGHT, moved), not calibrated.models[0].width


def _calibration(given: Path | Mapping[str, Any]) -> dict[str, float]:
    """All values of the calibration. Raises LogError."""
    where, loaded = ("the calibration", given) if isinstance(given, Mapping) else (str(given), read_yaml(given))
    required = [known.name for known in fields(ImageCalibration) if is_required(known)]
    optional = [known.name for known in fields(ImageCalibration) if not is_required(known)]
    if missing := [name for name in required if name not in loaded]:
        lists = f"{', '.join(required)} and may have {', '.join(optional)}"
        raise LogError(f"{where} lacks '{missing[0]}'; it needs {lists}")
    if unknown := [name for name in loaded if name not in (*required, *optional)]:
        raise LogError(f"{where} has the unknown '{unknown[0]}'; it may have {', '.join((*required, *optional))}")
    try:
        ImageCalibration(**loaded)
    except ValueError as error:
        raise LogError(f"{where}: {str(error).removeprefix('ImageCalibration.')}") from error
    given = {name: value for name, value in loaded.items() if value is not None}
    return {"fy": given["fx"], "cx_right": given["cx"], **given}


def read_frame(stamp: int, pair: tuple[Path, Path], values: dict[str, float]) -> StereoFrame:
    """The frame of two image files.

    values: fx, fy, cx, cy, cx_right (px), baseline (m), and maybe width and height. Raises LogError.
    """
    images = [read_pixels(path) for path in pair]
    height, width = images[0].shape[:2]
    if images[0].shape[:2] != images[1].shape[:2] or images[0].dtype != images[1].dtype:
        shapes = " and ".join(f"{pixels.shape[1]}x{pixels.shape[0]} {pixels.dtype}" for pixels in images)
        raise LogError(f"{pair[0]} and {pair[1]} differ in size or depth ({shapes})")
    if not (0 <= values["cx"] < width and 0 <= values["cy"] < height):
        raise LogError(
            f"the calibration's centre (cx {values['cx']:g}, cy {values['cy']:g}) is outside {pair[0]}, which is "
            f"{width}x{height}; give the calibration of images of this size"
        )
    if (size := (values.get("width", width), values.get("height", height))) != (width, height):
        raise LogError(f"{pair[0]} is {width}x{height}, but the calibration is for {size[0]:g}x{size[1]:g}")
    camera = StereoCamera(**{**values, "width": width, "height": height}, frame_id=LEFT)
    return StereoFrame(stamp, images[0], images[1], camera)


def _level_tilts(stamps: Iterable[int], offset: int) -> Iterator[Logged]:
    """The tilt of a rover that stands level at each stamp, and `offset` ns before and after it."""
    for stamp in stamps:
        for at in (stamp - offset, stamp, stamp + offset):
            yield at, "/imu/data", imu(at, IMU, np.array([0.0, 0.0, 0.0, 1.0]))
