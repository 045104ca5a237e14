"""Reads sections of the Devon Island rover navigation data set, for `roverflow import devon`.

Images are rectified pairs with numbers, whose times are in logs/image-times.txt. What the columns of the inclinometer's
files mean is not published: the rig file says it. The inclinometer is taken as fixed to base_link, with its axes.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from flow.contracts import counted
from recordings.errors import LogError
from recordings.importers.files import firsts, from_date, numbers_of, read_rows
from recordings.importers.pairing import pair_images
from recordings.importers.recording import BASE, IMU, ImagePair, ImportedRecording, Logged, common_size
from recordings.importers.rig import INCLINOMETER, LENS, Rig
from recordings.importers.track import upright
from recordings.ros2.tilt_from_msg import up_of
from recordings.ros2.to_msg import imu
from stages.data import Transform

# Width of the images -> f and (cx, cy), px, of the two rectified sets.
LENSES = {
    1280: (968.999694824, (635.139038086, 463.537109375)),
    512: (387.599884033, (253.755615234, 185.114852905)),
}
BASELINE = 0.239977002
TIMES = "image-times.txt"
SAMPLED, RAW = "inclinometer-sampled.txt", "inclinometer.txt"  # by number of the image, and by time


def read_devon(source: Path, rig: Rig, logs: Path | None = None) -> ImportedRecording:
    """The rectified images of a folder, with the logs of a folder `logs` in it or beside it. Raises LogError."""
    places = [logs] if logs is not None else [source / "logs", source.resolve().parent / "logs"]
    folder = next((place for place in places if (place / TIMES).exists()), None)
    if folder is None:
        raise LogError(f"there is no {places[0] / TIMES}; give --logs, or use import images for pairs without times")
    rig.need("the Devon Island data set", "height", "pitch_down", *INCLINOMETER)
    notes: list[str] = []
    times = [
        (int(row[0]), from_date(row[1], where)) for where, row in read_rows(folder / TIMES, 2) if row[0].isdecimal()
    ]
    stamps = firsts(times, "number", TIMES, notes)
    pairs = _pairs(source, stamps, notes)
    width, height = common_size(pairs)
    if width not in LENSES:
        rig.need(f"a set with images of {width}x{height}", *LENS)
    focal, centre = LENSES.get(width, (1.0, (0.0, 0.0)))
    camera = rig.camera((width, height), focal, BASELINE, centre)
    inclinometer = Transform(BASE, IMU, np.eye(3), np.zeros(3))
    tilts = [_tilts(folder, rig, stamps, pairs, notes)]
    return ImportedRecording.of_rectified(camera, pairs, rig.mount, inclinometer, sensors=tilts, notes=notes)


def _pairs(source: Path, stamps: dict[int, int], notes: list[str]) -> list[ImagePair]:
    """The pairs that have a time."""
    pairs, without = [], 0
    for left, right in zip(*pair_images(source, notes), strict=True):
        if "raw" in left.name:
            raise LogError(f"{left} is not rectified; give the folder of a rectified set")
        number = re.search(r"(\d+)$", left.stem)
        stamp = stamps.get(int(number[1])) if number else None
        if stamp is None:
            without += 1
        else:
            pairs.append(ImagePair(stamp, left, right))
    if without:
        notes.append(f"{counted(without, 'pair')} left out, as {TIMES} has no time for its number")
    if not pairs:
        raise LogError(f"{source} contains no pair of images with a time in {TIMES}")
    return sorted(pairs, key=lambda pair: pair.stamp)


def _tilts(folder: Path, rig: Rig, stamps: dict[int, int], pairs: list[ImagePair], notes: list[str]) -> list[Logged]:
    """The readings of the inclinometer; those of images without a time are not used. A note counts pairs without."""
    path = next((path for name in (SAMPLED, RAW) if (path := folder / name).exists()), None)
    if path is None:
        raise LogError(f"there is neither {SAMPLED} nor {RAW} in {folder}; download the logs again")
    columns = rig.pitch_column or 0, rig.roll_column or 0
    signs = np.array([rig.pitch_sign, rig.roll_sign], np.float64) * (np.pi / 180 if rig.angle_unit == "deg" else 1.0)
    found = []
    for where, row in read_rows(path, max(columns)):
        stamp = stamps.get(int(row[0])) if row[0].isdecimal() else from_date(row[0], where)
        pitch, roll = numbers_of([row[column - 1] for column in columns], where) * signs
        if stamp is None:
            continue
        try:
            up = up_of(pitch, roll, rig.tilt_model)  # type: ignore[arg-type]
        except LogError as error:
            raise LogError(f"{where}: {error}") from error
        found.append((stamp, "/inclinometer", imu(stamp, IMU, upright(up))))
    if not found:
        raise LogError(f"{path} contains no reading of an image with a time; download it again")
    without = {pair.stamp for pair in pairs}.difference(stamp for stamp, *_ in found)
    if without and path.name == SAMPLED:
        notes.append(f"{SAMPLED} has no reading for {counted(len(without), 'pair')}")
    return sorted(found, key=lambda item: item[0])
