"""Makes a log from stereo image files and a known camera attitude, for `roverflow import`.

The log contains what a rover's own log would: calibration, the mount of the camera, and an inclinometer. The rover
stands level and the camera is mounted on it pitched and rolled. So the attitude is in /tf_static, and the inclinometer,
fixed to the rover, reads level.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from flow.contracts import counted
from flow.parameters import check_parameters, is_required, parameter
from recordings.discovery.images import SIDES
from recordings.errors import LogError
from recordings.importers.files import read_bytes, read_pixels
from recordings.mcap.writer import Ros2Writer
from recordings.ros2.cdr import LAST_STAMP
from recordings.ros2.to_msg import camera_info, image, imu, transform_message
from recordings.source.calibration import pinhole
from recordings.source.transforms import BODY_FROM_OPTICAL
from stages.data import StereoCamera, StereoFrame, Transform

SUFFIXES = {".png", ".jpg", ".jpeg", ".ppm", ".pgm", ".tif", ".tiff", ".bmp"}
FIRST_STAMP = 1_000_000_000  # ns; a stamp of zero means "not stamped" in ROS
CAMERA_FRAMES = {"left": "left_camera_optical", "right": "right_camera_optical"}
# Ground truth beside the images of data sets, such as Middlebury's mask0nocc.png.
_NOT_CAMERAS = re.compile(r"(^|[^a-z])(mask|disp|disparity|depth|truth|gt)([^a-z]|$)", re.IGNORECASE)
_MAX_LISTED = 5  # files in a sentence
_POSITIVE: dict[str, Any] = {"low": 1e-6, "high": 1e9}
_ANY: dict[str, Any] = {"low": -1e9, "high": 1e9}


@dataclass(frozen=True, kw_only=True)
class ImageCalibration:
    """The calibration file of `import_images`."""

    fx: float = parameter(MISSING, "focal length", unit="px", **_POSITIVE)
    cx: float = parameter(MISSING, "principal point of the left image", unit="px", **_ANY)
    cy: float = parameter(MISSING, "principal point", unit="px", **_ANY)
    baseline: float = parameter(MISSING, "distance of the cameras", unit="m", **_POSITIVE)
    fy: float | None = parameter(None, "vertical focal length, by default fx", unit="px", **_POSITIVE)
    cx_right: float | None = parameter(None, "principal point of the right image, by default cx", unit="px", **_ANY)
    width: float | None = parameter(None, "width of the images", unit="px", **_POSITIVE)
    height: float | None = parameter(None, "height of the images", unit="px", **_POSITIVE)

    def __post_init__(self) -> None:
        check_parameters(self)


def import_images(
    left: Sequence[Path],
    right: Sequence[Path],
    calibration: Path | Mapping[str, Any],
    out: Path,
    *,
    pitch_down: float,
    roll: float = 0.0,
    height: float,
    rate: float = 1.0,
) -> int:
    """Write rectified image pairs as a log.

    Parameters
    ----------
    left, right : sequence of Path
        Image files, in pairs.
    calibration : Path or mapping
        YAML file or mapping with fx, cx, cy (px) and baseline (m); optionally fy, cx_right, width, height.
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

    Returns
    -------
    int
        The number of pairs.

    Raises
    ------
    LogError
        If a file cannot be read or does not fit the calibration.
    """
    values = _calibration(calibration)
    if len(left) != len(right) or not left:
        raise LogError(f"{len(left)} left and {len(right)} right images are not pairs; give equal numbers")
    if not 0 < height < math.inf:
        raise LogError(f"the camera's height must be positive and finite, not {height} m")
    if not 0 < rate <= 1e9 or FIRST_STAMP + (len(left) + 1) * 1e9 / rate >= LAST_STAMP:
        pairs = counted(len(left), "pair")
        raise LogError(f"the rate of {pairs} must be above 0 and at most 1e9 Hz, not {rate:g}; stamps end in 2038")
    if not abs(pitch_down) <= 90 or not abs(roll) <= 180:
        raise LogError(
            f"a pitch of {pitch_down} and a roll of {roll} degrees are impossible; give at most 90 and 180 degrees"
        )
    period = round(1e9 / rate)
    numbered = enumerate(zip(left, right, strict=True))
    frames = (read_frame(FIRST_STAMP + number * period, pair, values) for number, pair in numbered)
    tilt_offset = min(10_000_000, period // 4)
    write_frames(frames, out, pitch_down=pitch_down, roll=roll, height=height, tilt_offset=tilt_offset)
    return len(left)


def write_frames(
    frames: Iterable[StereoFrame],
    out: Path,
    *,
    pitch_down: float,
    roll: float = 0.0,
    height: float,
    tilt_offset: int = 10_000_000,
    write_more: Callable[[Ros2Writer, StereoFrame], None] | None = None,
) -> None:
    """Write rectified frames of one camera as a log, with the attitude of `import_images`.

    tilt_offset: ns before and after each frame with a tilt, so that one is on both sides of it; write_more: writes
    further messages of a frame.
    """
    with Ros2Writer(out) as writer:
        for number, frame in enumerate(frames):
            if number == 0:
                mounts = _mounts(frame.camera.baseline, pitch_down, roll, height)
                first = frame.stamp - tilt_offset
                writer.write("/tf_static", transform_message([(mount, first) for mount in mounts]), first)
            _write_tilt(writer, frame.stamp - tilt_offset)
            _write_images(writer, frame)
            if write_more is not None:
                write_more(writer, frame)
            _write_tilt(writer, frame.stamp)
            _write_tilt(writer, frame.stamp + tilt_offset)


def pair_images(folder: Path) -> tuple[list[Path], list[Path]]:
    """The left and the right images of a folder, in order.

    Names such as a-left.png and a-right.png, left/1.png and right/1.png, im0.png and im1.png are pairs. Raises LogError
    if there are no pairs, or an image has no partner.
    """
    if not folder.is_dir():
        raise LogError(f"{folder} is not a folder; give the folder with the left and right images")
    candidates = (f for pattern in ("*", "[!.]*/*") for f in folder.glob(pattern))
    files = sorted((f for f in candidates if f.suffix.lower() in SUFFIXES), key=lambda f: _natural(f, folder))
    named = {file.relative_to(folder).as_posix(): file for file in files}
    names = {name: file for name, file in named.items() if not _NOT_CAMERAS.search(name)}
    for word, other in SIDES:
        partners = {name: word.sub(other, name) for name in names if word.search(name)}
        pairs = [(one, two) for one, two in partners.items() if two in names and not _is_counter(one, word, names)]
        if not pairs:
            continue
        paired = {name for pair in pairs for name in pair}
        if alone := [name for name in names if name not in paired]:
            more = f" and {len(alone) - _MAX_LISTED} more have" if len(alone) > _MAX_LISTED else " has"
            listed = ", ".join(alone[:_MAX_LISTED])
            raise LogError(f"{folder}: {listed}{more} no partner; add it, or remove the image")
        folders = dict.fromkeys(parent for one, _ in pairs if word.search(parent := Path(one).parent.as_posix()))
        if len(folders) > 1:
            raise LogError(
                f"{folder} contains pairs of several cameras ({', '.join(folders)}); give the folder of one camera"
            )
        return [names[one] for one, _ in pairs], [names[two] for _, two in pairs]
    found = counted(len(files), "image")
    raise LogError(
        f"{folder} contains no image pairs, only {found}; the two names of a pair must differ in left/right, l/r or 0/1"
    )


def _is_counter(name: str, side: re.Pattern[str], names: Mapping[str, Path]) -> bool:
    """Whether the digit of the side in `name` counts images, because other names have 2, 3, ... there."""
    place = side.search(name)
    if place is None or not place.group().isdecimal():
        return False
    pattern = re.compile(re.escape(name[: place.start()]) + r"(\d+)" + re.escape(name[place.end() :]))
    counts = [int(found.group(1)) for found in map(pattern.fullmatch, names) if found is not None]
    return max(counts) > int(place.group()) + 1


def _natural(file: Path, folder: Path) -> list[tuple[int, int, str]]:
    """A sort key with the numbers in a name by value."""
    parts = re.split(r"(\d+)", file.relative_to(folder).as_posix())
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]


def _calibration(given: Path | Mapping[str, Any]) -> dict[str, float]:
    """All values of the calibration. Raises LogError."""
    where, loaded = "the calibration", given
    if not isinstance(given, Mapping):
        where = str(given)
        try:
            loaded = yaml.safe_load(read_bytes(given))
        except yaml.YAMLError as error:
            raise LogError(
                f"the calibration {given} is not plain YAML; write fx, cx, cy and baseline into a file of their own"
            ) from error
    required = [known.name for known in fields(ImageCalibration) if is_required(known)]
    optional = [known.name for known in fields(ImageCalibration) if not is_required(known)]
    if not isinstance(loaded, Mapping):
        raise LogError(f"{where} must map names to numbers: {', '.join(required)}")
    if missing := [name for name in required if name not in loaded]:
        lists = f"{', '.join(required)} and may have {', '.join(optional)}"
        raise LogError(f"{where} lacks '{missing[0]}'; it needs {lists}")
    if unknown := [name for name in loaded if name not in (*required, *optional)]:
        raise LogError(f"{where} has the unknown '{unknown[0]}'; it may have {', '.join((*required, *optional))}")
    try:
        ImageCalibration(**loaded)
    except ValueError as error:
        raise LogError(f"{where}: {str(error).removeprefix('ImageCalibration.')}") from error
    return {"fy": loaded["fx"], "cx_right": loaded["cx"], **loaded}


def read_frame(stamp: int, pair: tuple[Path, Path], values: dict[str, float]) -> StereoFrame:
    """The frame of two image files.

    values: fx, fy, cx, cy, cx_right (px), baseline (m), width and height; missing sizes are set. Raises LogError.
    """
    images = [read_pixels(path) for path in pair]
    height, width = images[0].shape[:2]
    if images[0].shape != images[1].shape or images[0].dtype != images[1].dtype:
        kinds = ("gray" if image.ndim == 2 else "colour" for image in images)
        shapes = " and ".join(f"{p.shape[1]}x{p.shape[0]} {p.dtype} {k}" for p, k in zip(images, kinds, strict=True))
        raise LogError(f"{pair[0]} and {pair[1]} differ in size or kind ({shapes})")
    if not (0 <= values["cx"] < width and 0 <= values["cy"] < height):
        raise LogError(
            f"the calibration's centre (cx {values['cx']:g}, cy {values['cy']:g}) is outside {pair[0]}, which is "
            f"{width}x{height}; give the calibration of images of this size"
        )
    if (values.setdefault("width", width), values.setdefault("height", height)) != (width, height):
        expected = f"{values['width']:g}x{values['height']:g}"
        raise LogError(f"{pair[0]} is {width}x{height}, but the calibration or the first pair is {expected}")
    camera = StereoCamera(**{**values, "width": width, "height": height}, frame_id=CAMERA_FRAMES["left"])
    return StereoFrame(stamp, images[0], images[1], camera)


def _mounts(baseline: float, pitch_down: float, roll: float, height: float) -> tuple[Transform, ...]:
    """The left camera on the rover, the right one beside it, and the inclinometer."""
    rotation = Rotation.from_euler("YX", [pitch_down, roll], degrees=True).as_matrix() @ BODY_FROM_OPTICAL
    return (
        Transform("base_link", CAMERA_FRAMES["left"], rotation, np.array([0.0, 0.0, height])),
        Transform(CAMERA_FRAMES["left"], CAMERA_FRAMES["right"], np.eye(3), np.array([baseline, 0.0, 0.0])),
        Transform("base_link", "imu_link", np.eye(3), np.zeros(3)),
    )


def _write_tilt(writer: Ros2Writer, stamp: int) -> None:
    writer.write("/imu/data", imu(stamp, "imu_link", np.array([0.0, 0.0, 0.0, 1.0])), stamp)


def _write_images(writer: Ros2Writer, frame: StereoFrame) -> None:
    for side, pixels in (("left", frame.left), ("right", frame.right)):
        info = camera_info(frame.stamp, CAMERA_FRAMES[side], pinhole(frame.camera, side))
        writer.write(f"/stereo/{side}/camera_info", info, frame.stamp)
        writer.write(f"/stereo/{side}/image_rect", image(frame.stamp, CAMERA_FRAMES[side], pixels), frame.stamp)
