"""Makes logs out of Middlebury stereo scenes, for `roverflow import middlebury`.

A scene (vision.middlebury.edu/stereo, version 3; any size, F, H or Q) is a folder of im0.png and im1.png, already
rectified, calib.txt, and the truth: disparities as PFM (rows from the bottom up, inf = unknown) and an occlusion mask.
Z = baseline * f / (d + doffs), so doffs is what the right camera's principal point is farther right. The truth goes to
the topics of a simulated log. Its message's range of disparities is that of the search, 0 to ndisp; as in
stereo_image_proc, doffs is added to its pixels and not to its range.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from recordings.errors import LogError
from recordings.importers.images import CAMERA_FRAMES, FIRST_STAMP, read_frame, write_frames
from recordings.mcap.writer import Ros2Writer
from recordings.ros2.to_msg import disparity_image, image
from recordings.scoring.stereo_metrics import SEEN_BY_BOTH, SEEN_BY_NONE, SEEN_BY_ONE, cropped_columns
from stages.data import Array, Disparity, PixelOrigin, StereoFrame

IMAGES, CALIBRATION, MASK = ("im0.png", "im1.png"), "calib.txt", "mask0nocc.png"
TRUTHS = ("disp0GT.pfm", "disp0.pfm")  # the first that is there
ROUNDED = 1.0  # px, by how much doffs may differ from what cam0 and cam1 say
HEIGHT = 1.0  # m; the data set does not tell how its camera stood
_PFM = re.compile(rb"Pf\s+(\d+)\s+(\d+)\s+([-+.\deE]+)(?:\r\n|\s)")
_NUMBERS = ("doffs", "baseline", "width", "height", "ndisp")
_POSITIVE = ("fx", "fy", "baseline", "width", "height", "ndisp")


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene. frame: left and right image with their camera; ndisp: how many disparities its authors search, px;
    truth: (H, W) float32, px, NaN = unknown; occlusion: (H, W) uint8, 255 seen by both cameras, 128 by the left one
    only, 0 unknown; None for what the folder does not hold; calibration: calib.txt as it stands."""

    name: str
    frame: StereoFrame
    ndisp: int
    truth: Array | None
    occlusion: Array | None
    calibration: dict[str, str]

    @property
    def disparities(self) -> int:
        """ndisp, rounded up to 16."""
        return cropped_columns(self.ndisp)


def import_scene(folder: Path, out: Path) -> str:
    """Write a scene as a log of one frame; returns what is in it and how to run it, for people.

    The camera is taken to look level, `HEIGHT` above the ground. Raises LogError where a file cannot be used.
    """
    scene = read_scene(folder)

    def also(writer: Ros2Writer, frame: StereoFrame) -> None:
        _write_truth(writer, scene)

    write_frames([scene.frame], out, pitch_down=0.0, height=HEIGHT, also=also)
    if scene.truth is None:
        said = f"without truth (no {' or '.join(TRUTHS)})"
    elif scene.occlusion is None:
        said = f"with true disparities, but not which are occluded (no {MASK})"
    else:
        said = "with true disparities and occlusions"
    return f"1 stereo frame {said}; run it with --set disparities={scene.disparities}"


def logs_of(source: Path, out: Path) -> list[tuple[Path, Path]]:
    """Each scene's folder and its log: `source` and `out` themselves, or where `source` holds scenes, those by name and
    a log of each in the folder `out`. Raises LogError where there is no scene, or `out` is not what it must be."""
    if not source.is_dir():
        raise LogError(f"{source} is not a folder; give a scene's folder, or one that holds scenes")
    if _is_scene(source):
        return [(source, out)]
    scenes = sorted(folder for folder in source.iterdir() if folder.is_dir() and _is_scene(folder))
    if not scenes:
        raise LogError(f"{source} holds no scene ({', '.join((*IMAGES, CALIBRATION))}), nor do the folders in it")
    if out.suffix == ".mcap" or (out.exists() and not out.is_dir()):
        raise LogError(
            f"{source} holds scenes, each with its own calibration, so each becomes a log of its own; give a folder "
            f"for the logs instead of {out}"
        )
    return [(folder, out / f"{folder.name}.mcap") for folder in scenes]


def read_scene(folder: Path, stamp: int = FIRST_STAMP) -> Scene:
    """The scene of a folder, its frame at `stamp` (ns). Raises LogError where a file is missing, except of the truth,
    or cannot be used."""
    text, numbers = _calibration(folder / CALIBRATION)
    ndisp = int(numbers.pop("ndisp"))
    left, right = (folder / name for name in IMAGES)
    frame = read_frame(stamp, (left, right), numbers)
    path = next((folder / name for name in TRUTHS if (folder / name).exists()), None)
    truth = _fitting(read_pfm(path), frame, path) if path is not None else None
    mask = folder / MASK
    occlusion = _fitting(_codes(mask), frame, mask) if truth is not None and mask.exists() else None
    return Scene(folder.resolve().name, frame, ndisp, truth, occlusion, text)


def read_pfm(path: Path) -> Array:
    """The (H, W) float32 pixels of a PFM file of one channel, first row at the top, NaN where they are not finite.

    A negative scale in its header says little-endian; how large it is does not matter. Raises LogError.
    """
    data = _bytes(path)
    header = _PFM.match(data)
    if header is None:
        raise LogError(f"{path} is not a PFM file of one channel ('Pf', width, height, scale); get it again")
    try:
        width, height, scale = int(header[1]), int(header[2]), float(header[3])
    except ValueError as error:
        raise LogError(f"{path}: its scale {header[3].decode()} is not a number; get it again") from error
    have, due = len(data) - header.end(), 4 * width * height
    if have != due or not due:
        raise LogError(f"{path} has {have} bytes of pixels where {width}x{height} take {due}; get it again")
    rows = np.frombuffer(data, "<f4" if scale < 0 else ">f4", offset=header.end()).reshape(height, width)
    if not np.isfinite(rows).any():
        raise LogError(f"{path} has no pixel that is known; get it again")
    return np.where(np.isfinite(rows), rows, np.nan).astype(np.float32)[::-1].copy()


def _is_scene(folder: Path) -> bool:
    return any((folder / name).exists() for name in (IMAGES[0], CALIBRATION))


def _calibration(path: Path) -> tuple[dict[str, str], dict[str, float]]:
    """calib.txt as text, and as fx, fy, cx, cy, cx_right, width, height, ndisp (px), baseline (m)."""
    try:
        lines = _bytes(path).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise LogError(f"{path} is not a text file; get it again") from error
    text = {key.strip(): value.strip() for key, found, value in (line.partition("=") for line in lines) if found}
    for name in ("cam0", *_NUMBERS):
        if name not in text:
            raise LogError(f"{path} lacks '{name}'; it needs {', '.join(('cam0', *_NUMBERS))}")
    try:
        cam0 = _matrix(text["cam0"])
        values = {name: float(text[name]) for name in _NUMBERS}
        (fx, _, cx), (_, fy, cy) = (float(value) for value in cam0[0]), (float(value) for value in cam0[1])
        beside = float(_matrix(text["cam1"])[0, 2]) - cx if "cam1" in text else values["doffs"]
    except (ValueError, IndexError) as error:
        raise LogError(f"{path} has a line that is no number or matrix ({error}); get it again") from error
    doffs, baseline = values.pop("doffs"), values["baseline"] / 1000  # which is in mm
    values |= {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "cx_right": cx + doffs, "baseline": baseline}
    for name, value in values.items():
        if not np.isfinite(value) or (name in _POSITIVE and value <= 0):
            raise LogError(f"{path}: {name} is {value:g}, which no camera has; get it again")
    if abs(beside - doffs) > ROUNDED:
        raise LogError(f"{path}: doffs is {doffs:g}, by cam0 and cam1 it is {beside:g}; get it again")
    return text, values


def _matrix(text: str) -> Array:
    """A matrix as Matlab writes one: [1 2; 3 4]."""
    return np.array([row.split() for row in text.strip("[]").split(";")], np.float64)


def _codes(path: Path) -> Array:
    data = np.frombuffer(_bytes(path), np.uint8)
    mask = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if data.size else None
    if mask is None:
        raise LogError(f"{path} is not an image that can be read; get it again")
    if odd := np.setdiff1d(mask, (SEEN_BY_BOTH, SEEN_BY_ONE, SEEN_BY_NONE)).tolist():
        raise LogError(f"{path} has a pixel of {odd[0]}; an occlusion mask has 255, 128 and 0 only")
    return np.asarray(mask)


def _fitting(truth: Array, frame: StereoFrame, path: Path) -> Array:
    """`truth`, if it has the size of the images."""
    height, width = frame.left.shape[:2]
    if truth.shape != (height, width):
        size = f"{truth.shape[1]}x{truth.shape[0]}"
        raise LogError(f"{path} is {size}, the images are {width}x{height}; take all files of a scene in one size")
    return truth


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise LogError(f"cannot read {path}: {error.strerror or error}") from error


def _write_truth(writer: Ros2Writer, scene: Scene) -> None:
    stamp, truth = scene.frame.stamp, scene.truth
    writer.metadata("middlebury", {"scene": scene.name, **scene.calibration})
    if truth is not None:
        known = np.isfinite(truth)
        source = np.where(known, np.uint8(PixelOrigin.MEASURED), np.uint8(PixelOrigin.UNKNOWN))
        disparity = Disparity(stamp, truth, source, known.astype(np.float32), camera=scene.frame.camera)
        message = replace(disparity_image(disparity), min_disparity=0.0, max_disparity=float(scene.ndisp))
        writer.write("/truth/disparity", message, stamp)
    if scene.occlusion is not None:
        writer.write("/truth/occlusion", image(stamp, CAMERA_FRAMES["left"], scene.occlusion), stamp)
