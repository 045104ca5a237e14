"""Reads an attitude of the camera for each pair of images from a CSV file, for `roverflow import images`.

Its first line names the columns: name (of the left image, with or without ending) or stamp (ns), pitch_down, and maybe
roll and yaw, deg. pitch_down is the angle below the horizon; yaw is to the left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from recordings.errors import LogError
from recordings.importers.files import nanoseconds, numbers_of, read_rows
from recordings.importers.recording import ImagePair
from recordings.importers.rig import Rig
from stages.data import Transform

COLUMNS = ("stamp", "name", "pitch_down", "roll", "yaw")


def read_attitudes(path: Path, pairs: Sequence[ImagePair], rig: Rig) -> tuple[list[ImagePair], list[Transform]]:
    """The pairs in the order of their stamps, and the mount of the camera at each. Raises LogError.

    A stamp in the file is that of the pair, and names the image if there is no name.
    """
    rows = list(read_rows(path, 2, ","))
    header = rows[0][1] if rows else []
    unknown = [name for name in header if name not in COLUMNS]
    if unknown or "pitch_down" not in header or not {"name", "stamp"} & {*header}:
        wrong = f"the unknown column '{unknown[0]}'" if unknown else f"the columns {', '.join(header)}"
        raise LogError(f"{path} has {wrong}; its first line must name {', '.join(COLUMNS)} (one of the first two)")
    found: dict[str, tuple[str, dict[str, str]]] = {}
    for where, row in rows[1:]:
        if len(row) != len(header):
            raise LogError(f"{where} has {len(row)} columns, but the first line names {len(header)}")
        values = dict(zip(header, row, strict=True))
        found[values.pop("name", values.get("stamp", ""))] = where, values
    placed = []
    for pair in pairs:
        name = next((name for name in (pair.left.name, pair.left.stem) if name in found), None)
        if name is None:
            raise LogError(f"{path} has no row for {pair.left.name}; it needs one for each left image")
        where, values = found[name]
        stamp = nanoseconds(given, where) if (given := values.pop("stamp", None)) is not None else pair.stamp
        turns = dict(zip(values, np.radians(numbers_of([*values.values()], where)).tolist(), strict=True))
        try:
            placed.append((replace(pair, stamp=stamp), replace(rig, **turns).mount))
        except ValueError as error:
            raise LogError(f"{where}: {str(error).removeprefix('Rig.')}") from error
    placed.sort(key=lambda item: item[0].stamp)
    return [pair for pair, _ in placed], [mount for _, mount in placed if mount is not None]
