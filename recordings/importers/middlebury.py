"""Makes logs from Middlebury stereo scenes, for `roverflow import middlebury`.

A scene (vision.middlebury.edu/stereo, version 3; size F, H or Q) is a folder with im0.png and im1.png, already
rectified, calib.txt, and ground truth: disparities as PFM (rows from the bottom up, inf = unknown) and an occlusion
mask. Z = baseline * f / (d + doffs), with doffs = cx_right - cx. The truth is written to the topics of a simulated log.
As in stereo_image_proc, doffs is added to the pixels of the disparity message, but not to its range, 0 to ndisp.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from recordings.errors import LogError
from recordings.importers.files import of_size, read_bytes, read_lines
from recordings.importers.images import read_frame, standing
from recordings.importers.recording import (
    FIRST_STAMP,
    LEFT,
    ImagePair,
    ImportedRecording,
    Logged,
    beside,
    rectified_models,
)
from recordings.importers.rig import Rig
from recordings.ros2.to_msg import disparity_image, exact_disparity, image
from recordings.scoring.stereo_metrics import SEEN_BY_BOTH, SEEN_BY_NONE, SEEN_BY_ONE, cropped_columns
from stages.data import Array, StereoFrame

IMAGES, CALIBRATION, MASK = ("im0.png", "im1.png"), "calib.txt", "mask0nocc.png"
TRUTHS = ("disp0GT.pfm", "disp0.pfm")  # the first one found is used
HEIGHT = 1.0  # m; the data set does not contain the camera's pose
_PFM = re.compile(rb"Pf\s+(\d+)\s+(\d+)\s+([-+.\deE]+)(?:\r\n|\s)")
_NUMBERS = ("doffs", "baseline", "width", "height", "ndisp")
_POSITIVE = ("fx", "fy", "baseline", "width", "height", "ndisp")


@dataclass(frozen=True, eq=False)
class MiddleburyScene:
    """A scene.

    frame: left and right image with their camera; ndisp: the search range of its authors, px; truth: (H, W) float32,
    px, NaN = unknown, or None; occlusion: (H, W) uint8, 255 seen by both cameras, 128 by the left one, 0 unknown, or
    None; calibration: the entries of calib.txt.
    """

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


def read_middlebury(source: Path, rig: Rig) -> ImportedRecording:
    """The scene of a folder as a recording of one frame; a note says what it contains, and how to run it.

    Assumes a level camera `HEIGHT` above the ground. Raises LogError if a file cannot be used.
    """
    scene = read_scene(source)
    pair, camera = ImagePair(scene.frame.stamp, *(source / name for name in IMAGES)), scene.frame.camera
    level = replace(rig, height=HEIGHT, pitch_down=0.0)
    if scene.truth is None:
        content = f"without truth (no {' or '.join(TRUTHS)})"
    elif scene.occlusion is None:
        content = f"with true disparities, but without occlusions (no {MASK})"
    else:
        content = "with true disparities and occlusions"
    return replace(
        standing([pair], rectified_models(camera), beside(camera), level),
        more=lambda number: _truth(scene),
        metadata=("middlebury", {"scene": scene.name, **scene.calibration}),
        notes=[f"{content}; run it with --set disparities={scene.disparities}"],
    )


def read_scene(folder: Path | str, stamp: int = FIRST_STAMP) -> MiddleburyScene:
    """The scene of a folder.

    Parameters
    ----------
    folder
        With im0.png, im1.png and calib.txt; disp0GT.pfm and mask0nocc.png may be missing.
    stamp
        Of the frame, ns.

    Raises
    ------
    LogError
        If a file is missing or cannot be used.

    Examples
    --------
    >>> read_scene("trainingQ/Teddy").ndisp  # doctest: +SKIP
    64
    """
    folder = Path(folder)
    if not (folder / CALIBRATION).is_file():
        raise LogError(f"{folder} has no {CALIBRATION}; give the folder of one scene")
    text, numbers = _calibration(folder / CALIBRATION)
    ndisp = int(numbers.pop("ndisp"))
    left, right = (folder / name for name in IMAGES)
    frame = read_frame(stamp, (left, right), numbers)
    path = next((folder / name for name in TRUTHS if (folder / name).exists()), None)
    truth = of_size(read_pfm(path), frame.camera, path) if path is not None else None
    mask = folder / MASK
    occlusion = of_size(_codes(mask), frame.camera, mask) if truth is not None and mask.exists() else None
    return MiddleburyScene(folder.resolve().name, frame, ndisp, truth, occlusion, text)


def read_pfm(path: Path) -> Array:
    """The (H, W) float32 pixels of a PFM file of one channel, first row at the top, NaN if not finite.

    A negative scale in its header means little-endian; its size is ignored. Raises LogError.
    """
    data = read_bytes(path)
    header = _PFM.match(data)
    if header is None:
        raise LogError(f"{path} is not a PFM file of one channel ('Pf', width, height, scale); download it again")
    try:
        width, height, scale = int(header[1]), int(header[2]), float(header[3])
    except ValueError as error:
        raise LogError(f"{path}: its scale {header[3].decode()} is not a number; download it again") from error
    size, expected = len(data) - header.end(), 4 * width * height
    if size != expected or not expected:
        raise LogError(f"{path} has {size} bytes of pixels, not {expected} for {width}x{height}; download it again")
    rows = np.frombuffer(data, "<f4" if scale < 0 else ">f4", offset=header.end()).reshape(height, width)
    return np.where(np.isfinite(rows), rows, np.nan).astype(np.float32)[::-1].copy()


def _calibration(path: Path) -> tuple[dict[str, str], dict[str, float]]:
    """The entries of calib.txt as text, and as fx, fy, cx, cy, cx_right, width, height, ndisp (px), baseline (m)."""
    entries = (line.partition("=") for _, line in read_lines(path))
    text = {key.strip(): value.strip() for key, found, value in entries if found}
    for name in ("cam0", *_NUMBERS):
        if name not in text:
            raise LogError(f"{path} lacks '{name}'; it needs {', '.join(('cam0', *_NUMBERS))}")
    try:
        cam0 = _matrix(text["cam0"])
        values = {name: float(text[name]) for name in _NUMBERS}
        (fx, _, cx), (_, fy, cy) = (float(value) for value in cam0[0]), (float(value) for value in cam0[1])
    except (ValueError, IndexError) as error:
        raise LogError(f"{path} has an entry that is not a number or matrix ({error}); download it again") from error
    doffs, baseline = values.pop("doffs"), values["baseline"] / 1000  # from mm
    values |= {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "cx_right": cx + doffs, "baseline": baseline}
    for name, value in values.items():
        if not np.isfinite(value) or (name in _POSITIVE and value <= 0):
            raise LogError(f"{path}: {name} is {value:g}, which is impossible for a camera; download it again")
    return text, values


def _matrix(text: str) -> Array:
    """A matrix in Matlab's notation: [1 2; 3 4]."""
    return np.array([row.split() for row in text.strip("[]").split(";")], np.float64)


def _codes(path: Path) -> Array:
    data = np.frombuffer(read_bytes(path), np.uint8)
    mask = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if data.size else None
    if mask is None:
        raise LogError(f"{path} is not a readable image; download it again")
    if invalid := np.setdiff1d(mask, (SEEN_BY_BOTH, SEEN_BY_ONE, SEEN_BY_NONE)).tolist():
        raise LogError(f"{path} has a pixel of {invalid[0]}; an occlusion mask has only 255, 128 and 0")
    return np.asarray(mask)


def _truth(scene: MiddleburyScene) -> Iterator[Logged]:
    stamp, truth = scene.frame.stamp, scene.truth
    if truth is not None:
        message = disparity_image(exact_disparity(stamp, truth, scene.frame.camera))
        yield stamp, "/truth/disparity", replace(message, min_disparity=0.0, max_disparity=float(scene.ndisp))
    if scene.occlusion is not None:
        yield stamp, "/truth/occlusion", image(stamp, LEFT, scene.occlusion)
