"""Folders of other recordings with one changed file. A seed is the place of the file, then its content."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

from flow.cli.main import parser
from tests.fuzz.mutations import mutated_bytes, mutated_text
from tests.recordings.importers.middlebury_scene import write_scene
from tests.recordings.importers.simulated import EXACT, RIG, gray
from tests.recordings.importers.test_euroc import SIMULATION, write_euroc
from tests.recordings.importers.test_kitti import write_drive, write_sequence
from tests.recordings.importers.test_poses import write_lusnar, write_tartanair
from tests.recordings.importers.test_rovers import BEACH, write_devon, write_katwijk

TEXTS = (".txt", ".csv", ".yaml")
OTHERS = (".mat", ".npy", ".pfm")


def _euroc(home: Path) -> None:
    write_euroc(SIMULATION, home / "room")
    (home / "rig.yaml").write_text(RIG)


# Kind of folder -> what writes it, and the arguments of `import` that read it; files are relative to it
LAYOUTS: dict[str, tuple[Callable[[Path], Any], tuple[str, ...]]] = {
    "euroc": (_euroc, ("euroc", "room", "--rig", "rig.yaml")),
    "drive": (lambda home: write_drive(gray(EXACT), home), ("kitti", "2011_09_26_drive_0001_sync")),
    "sequence": (lambda home: write_sequence(gray(EXACT), home), ("kitti", "sequences/05", "--rig", "rig.yaml")),
    "tartanair": (
        lambda home: write_tartanair(EXACT, home / "P0", ("left", "right")),
        ("tartanair", "P0", "--rig", "P0/rig.yaml"),
    ),
    "lusnar": (lambda home: write_lusnar(EXACT, home / "M1"), ("lusnar", "M1", "--rig", "M1/rig.yaml")),
    "katwijk": (
        lambda home: write_katwijk(BEACH, home / "P1"),
        ("katwijk", "P1", "--calibration", "P1/LocCam_calibstruct.mat", "--rig", "P1/rig.yaml"),
    ),
    "devon": (
        lambda home: write_devon(EXACT, home), ("devon", "color-rectified-1280x960-s01", "--rig", "rig.yaml"),
    ),
    "middlebury": (lambda home: write_scene(home / "Scene"), ("middlebury", "Scene")),
}  # fmt: skip
_homes: dict[str, Path] = {}  # of the seeds' folders


def seeds(folder: Path) -> list[bytes]:
    """Every file of every kind of folder that is no image."""
    found = []
    for kind, (write, _) in LAYOUTS.items():
        _homes[kind] = folder / kind
        _homes[kind].mkdir()
        write(_homes[kind])
        paths = sorted(path for path in _homes[kind].rglob("*") if path.suffix in TEXTS + OTHERS)
        found += [f"{path.relative_to(folder)}\n".encode() + path.read_bytes() for path in paths]
    return found


def mutated(chance: Random, content: bytes) -> bytes:
    """A change of the file; its place stays."""
    place, _, rest = content.partition(b"\n")
    mutate = mutated_text if place.decode().endswith(TEXTS) else mutated_bytes
    return place + b"\n" + mutate(chance, rest)


def read(path: Path) -> None:
    """Import a copy of the folder with the changed file."""
    place, _, rest = path.read_bytes().partition(b"\n")
    kind, _, name = place.decode().partition("/")
    home = path.with_suffix(".copy")
    shutil.copytree(_homes[kind], home, copy_function=os.symlink)
    (home / name).unlink()
    (home / name).write_bytes(rest)
    words = [str(home / word) if (home / word).exists() else word for word in LAYOUTS[kind][1]]
    options = parser().parse_args(["import", words[0], words[1], str(path.with_suffix(".mcap")), *words[2:]])
    options.command(options)
