"""PGM and YAML as nav2_map_server and ROS 1 map_server read them in trinary mode: first row largest y.

Unknown is gray 205, an occupancy of 1 - 205/255 = 0.196. Occupancy below free_thresh is free, so a higher threshold
(such as Nav2's former 0.25) would turn unknown ground into free ground.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from recordings.export.mosaic import Mosaic
from stages.data import Cell

FREE, OCCUPIED, UNKNOWN = 254, 0, 205
OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.196


def write_pgm(path: Path, mosaic: Mosaic, layer: str) -> None:
    """Write a layer of `Cell` codes."""
    rows, cols = mosaic.shape
    with path.open("wb") as file:
        file.write(f"P5\n{cols} {rows}\n255\n".encode())
        for strip in mosaic.strips(layer):
            grays = np.select([strip == Cell.FREE, strip == Cell.HAZARD], [FREE, OCCUPIED], UNKNOWN)
            file.write(grays.astype(np.uint8).tobytes())


def write_yaml(path: Path, picture: str, mosaic: Mosaic) -> None:
    """Write the file that map_server opens. picture: name of the PGM beside it."""
    x, y = mosaic.origin
    path.write_text(
        f"# frame_id: {mosaic.frame_id}\n"
        f"image: {picture}\n"
        "mode: trinary\n"
        f"resolution: {mosaic.resolution:.12g}\n"
        f"origin: [{x:.9f}, {y:.9f}, 0.0]\n"
        "negate: 0\n"
        f"occupied_thresh: {OCCUPIED_THRESH}\n"
        f"free_thresh: {FREE_THRESH}\n",
        encoding="utf-8",
    )
