"""Makes a log out of stereo image files and a known camera attitude, for `roverflow import`.

The log says everything that a rover's own would: calibration, the camera's place on the rover, and an inclinometer. The
rover stands level on the ground and the camera is mounted on it pitched and rolled, so the attitude is in /tf_static
and the inclinometer, fixed to the rover, reads level.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from flow.contracts import counted
from recordings.errors import LogError
from recordings.mcap.writer import Ros2Writer
from recordings.ros2.cdr import LAST_STAMP
from recordings.ros2.image_from_msg import unpacked_pixels
from recordings.ros2.to_msg import camera_info, image, imu, transform_message
from recordings.source.calibration import pinhole
from recordings.source.discovery import SIDES
from recordings.source.transforms import BODY_FROM_OPTICAL
from stages.data import Array, StereoCamera, StereoFrame, Transform

SUFFIXES = {".png", ".jpg", ".jpeg", ".ppm", ".pgm", ".tif", ".tiff", ".bmp"}
FIRST_STAMP = 1_000_000_000  # ns; a stamp of zero means "not stamped" in ROS
CAMERA_FRAMES = {"left": "left_camera_optical", "right": "right_camera_optical"}
# Ground truth that data sets put beside their images, as Middlebury's mask0nocc.png.
_NOT_CAMERAS = re.compile(r"(^|[^a-z])(mask|disp|disparity|depth|truth|gt)([^a-z]|$)", re.IGNORECASE)
_LISTED = 5  # files in a sentence
_LARGEST = 1e9  # px or m
_REQUIRED, _OPTIONAL = ("fx", "cx", "cy", "baseline"), ("fy", "cx_right", "width", "height")


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
    """Write rectified image pairs as a log; returns how many.

    calibration: YAML file or mapping with fx, cx, cy (px), baseline (m), and optionally fy, cx_right, width, height.
    pitch_down: how far the camera looks below the horizon, deg; roll: about its line of sight, deg, right side down
    positive; height: of the left camera above the ground, m; rate: pairs a second in the log.
    Raises LogError for files that cannot be read or do not fit the calibration.
    """
    values = _calibration(calibration)
    if len(left) != len(right) or not left:
        raise LogError(
            f"{len(left)} left and {len(right)} right images are not pairs; give as many of both, at least one"
        )
    if not 0 < height < math.inf:
        raise LogError(f"the camera's height must be positive and finite, not {height} m")
    if not 0 < rate <= 1e9 or FIRST_STAMP + (len(left) + 1) * 1e9 / rate >= LAST_STAMP:
        those = counted(len(left), "pair")
        raise LogError(f"the rate of {those} must be above 0 and at most 1e9 Hz, not {rate:g}; stamps end in 2038")
    if not abs(pitch_down) <= 90 or not abs(roll) <= 180:
        raise LogError(f"no camera looks {pitch_down} degrees down, rolled by {roll}; give degrees up to 90 and 180")
    period = round(1e9 / rate)
    pairs = enumerate(zip(left, right, strict=True))
    frames = (read_frame(FIRST_STAMP + number * period, pair, values) for number, pair in pairs)
    around = min(10_000_000, period // 4)
    write_frames(frames, out, pitch_down=pitch_down, roll=roll, height=height, around=around)
    return len(left)


def write_frames(
    frames: Iterable[StereoFrame],
    out: Path,
    *,
    pitch_down: float,
    roll: float = 0.0,
    height: float,
    around: int = 10_000_000,
    also: Callable[[Ros2Writer, StereoFrame], None] | None = None,
) -> None:
    """Write rectified frames of one camera as a log, its attitude as in `import_images`.

    around: ns before and after each frame at which there is a tilt as well, so that one is on both sides of it; also:
    writes what else belongs to a frame.
    """
    with Ros2Writer(out) as writer:
        for number, frame in enumerate(frames):
            if number == 0:
                mounts = _mounts(frame.camera.baseline, pitch_down, roll, height)
                first = frame.stamp - around
                writer.write("/tf_static", transform_message([(mount, first) for mount in mounts]), first)
            _write_tilt(writer, frame.stamp - around)
            _write_images(writer, frame)
            if also is not None:
                also(writer, frame)
            _write_tilt(writer, frame.stamp)
            _write_tilt(writer, frame.stamp + around)


def pair_images(folder: Path) -> tuple[list[Path], list[Path]]:
    """The left and the right images of a folder, in order: a-left.png with a-right.png, left/1.png with right/1.png,
    im0.png with im1.png. Raises LogError where there are none, or an image has no partner."""
    if not folder.is_dir():
        raise LogError(f"{folder} is not a folder; give the folder that holds the left and right images")
    near = (f for pattern in ("*", "[!.]*/*") for f in folder.glob(pattern))
    files = sorted((f for f in near if f.suffix.lower() in SUFFIXES), key=lambda f: _natural(f, folder))
    named = {file.relative_to(folder).as_posix(): file for file in files}
    names = {name: file for name, file in named.items() if not _NOT_CAMERAS.search(name)}
    for word, other in SIDES:
        partners = {name: word.sub(other, name) for name in names if word.search(name)}
        pairs = [(one, two) for one, two in partners.items() if two in names and not _counted(one, word, names)]
        if not pairs:
            continue
        paired = {name for pair in pairs for name in pair}
        if alone := [name for name in names if name not in paired]:
            more = f" and {len(alone) - _LISTED} more have" if len(alone) > _LISTED else " has"
            listed = ", ".join(alone[:_LISTED])
            raise LogError(f"{folder}: {listed}{more} no partner; add it, or take the image away")
        homes = dict.fromkeys(parent for one, _ in pairs if word.search(parent := Path(one).parent.as_posix()))
        if len(homes) > 1:
            raise LogError(f"{folder} holds pairs of several cameras ({', '.join(homes)}); give a folder that has one")
        return [names[one] for one, _ in pairs], [names[two] for _, two in pairs]
    held = counted(len(files), "image")
    raise LogError(f"{folder} holds no image pairs; name them alike but for left/right, l/r or 0/1 ({held})")


def _counted(name: str, side: re.Pattern[str], names: Mapping[str, Path]) -> bool:
    """Whether the digit that would be the side of `name` counts images: others have 2, 3, ... in its place."""
    place = side.search(name)
    if place is None or not place.group().isdecimal():
        return False
    alike = re.compile(re.escape(name[: place.start()]) + r"(\d+)" + re.escape(name[place.end() :]))
    counts = [int(found.group(1)) for found in map(alike.fullmatch, names) if found is not None]
    return max(counts) > int(place.group()) + 1


def _natural(file: Path, folder: Path) -> list[tuple[int, int, str]]:
    """A key that sorts numbers in names by value."""
    parts = re.split(r"(\d+)", file.relative_to(folder).as_posix())
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]


def _calibration(given: Path | Mapping[str, Any]) -> dict[str, float]:
    """The calibration's values, complete. Raises LogError naming what is wrong with it."""
    where = "the calibration" if isinstance(given, Mapping) else str(given)
    if isinstance(given, Mapping):
        loaded: Any = dict(given)
    else:
        try:
            loaded = yaml.safe_load(Path(given).read_text())
        except OSError as error:
            raise LogError(f"cannot read the calibration {given}: {error.strerror or error}") from error
        except (UnicodeDecodeError, yaml.YAMLError) as error:
            raise LogError(
                f"cannot read the calibration {given}, which is not plain YAML; write fx, cx, cy and baseline into a "
                "file of their own"
            ) from error
    if not isinstance(loaded, dict):
        raise LogError(f"{where} must map names to numbers: {', '.join(_REQUIRED)}")
    for name in _REQUIRED:
        if name not in loaded:
            raise LogError(
                f"{where} lacks '{name}'; it needs {', '.join(_REQUIRED)} and may have {', '.join(_OPTIONAL)}"
            )
    for name, value in loaded.items():
        if name not in (*_REQUIRED, *_OPTIONAL):
            raise LogError(f"{where} has the unknown '{name}'; it may have {', '.join((*_REQUIRED, *_OPTIONAL))}")
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= _LARGEST:
            raise LogError(f"{where}: '{name}' must be a number up to {_LARGEST:g}, not {value!r}")
        if name in ("fx", "fy", "baseline", "width", "height") and value <= 0:
            raise LogError(f"{where}: '{name}' must be positive, not {value}")
    return {"fy": loaded["fx"], "cx_right": loaded["cx"], **loaded}


def read_frame(stamp: int, pair: tuple[Path, Path], values: dict[str, float]) -> StereoFrame:
    """The frame of two image files. values: fx, fy, cx, cy, cx_right (px), baseline (m), and width and height, which it
    sets where they are not there. Raises LogError for files that cannot be read or do not fit."""
    images = [_pixels(path) for path in pair]
    height, width = images[0].shape[:2]
    if images[0].shape != images[1].shape or images[0].dtype != images[1].dtype:
        kinds = ("gray" if image.ndim == 2 else "colour" for image in images)
        shapes = " and ".join(f"{p.shape[1]}x{p.shape[0]} {p.dtype} {k}" for p, k in zip(images, kinds, strict=True))
        raise LogError(f"{pair[0]} and {pair[1]} differ in size or kind ({shapes})")
    if not (0 <= values["cx"] < width and 0 <= values["cy"] < height):
        raise LogError(
            f"{pair[0]} is {width}x{height}, the calibration's centre (cx {values['cx']:g}, cy {values['cy']:g}) lies "
            "outside; give the calibration of images of this size"
        )
    if (values.setdefault("width", width), values.setdefault("height", height)) != (width, height):
        expected = f"{values['width']:g}x{values['height']:g}"
        raise LogError(f"{pair[0]} is {width}x{height}, the calibration or the first pair is {expected}")
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


def _pixels(path: Path) -> Array:
    """Gray or RGB pixels of an image file."""
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise LogError(f"cannot read {path}: {error.strerror or error}") from error
    pixels = unpacked_pixels(data)
    if pixels is None:
        raise LogError(f"{path} is not an image of 8 or 16 bit that can be read")
    return pixels
