"""Reads an attitude of the camera for each pair of images from a CSV file, for `roverflow import images`.

Its first line names the columns: name (of the left image, with or without ending and folders) or stamp (ns),
pitch_down, and maybe roll and yaw, deg. pitch_down is the angle below the horizon; yaw is to the left.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path, PurePath

import numpy as np

from flow.contracts import counted
from recordings.errors import LogError
from recordings.importers.files import nanoseconds, numbers_of, read_rows
from recordings.importers.recording import ImagePair
from recordings.importers.rig import Rig
from stages.data import Transform

COLUMNS = ("stamp", "name", "pitch_down", "roll", "yaw")


def read_attitudes(
    path: Path, pairs: Sequence[ImagePair], rig: Rig, notes: list[str]
) -> tuple[list[ImagePair], list[Transform]]:
    """The pairs in the order of their stamps, and the mount of the camera at each. Raises LogError.

    A stamp in the file is that of the pair, and names the image if there is no name. A note counts the rows of images
    that do not exist.
    """
    named, others = _named(pairs), []
    placed: dict[int, tuple[ImagePair, Transform | None]] = {}
    for where, values in _rows(path):
        name = values.pop("name", values.get("stamp", ""))
        numbers = named.get(PurePath(name).as_posix().lstrip("/"), [])
        if not numbers:
            others.append(name)
            continue
        pair = pairs[numbers[0]]
        if len(numbers) > 1:
            both = f"{pair.left} and {pairs[numbers[1]].left}"
            raise LogError(f"{where}: '{name}' may be {both}; write the name with its folder")
        if numbers[0] in placed:
            raise LogError(f"{where} has another attitude of {pair.left}; give one row for each left image")
        stamp = nanoseconds(given, where) if (given := values.pop("stamp", None)) is not None else pair.stamp
        turns = dict(zip(values, np.radians(numbers_of([*values.values()], where)).tolist(), strict=True))
        try:
            placed[numbers[0]] = replace(pair, stamp=stamp), replace(rig, **turns).mount
        except ValueError as error:
            raise LogError(f"{where}: {str(error).removeprefix('Rig.')}") from error
    if lacking := [pair.left.name for number, pair in enumerate(pairs) if number not in placed]:
        raise LogError(f"{path} has no row for {lacking[0]}; it needs one for each left image")
    if others:
        notes.append(f"{path.name} has {counted(len(others), 'row')} of images that do not exist, first: {others[0]}")
    ordered = sorted(placed.values(), key=lambda item: item[0].stamp)
    return [pair for pair, _ in ordered], [mount for _, mount in ordered if mount is not None]


def _rows(path: Path) -> Iterator[tuple[str, dict[str, str]]]:
    """The values of each row by the names of their columns, after its place in words. Raises LogError."""
    rows = list(read_rows(path, 2, ","))
    header = rows[0][1] if rows else []
    unknown = [name for name in header if name not in COLUMNS]
    repeated = [name for name in header if header.count(name) > 1]
    if unknown or repeated or "pitch_down" not in header or not {"name", "stamp"} & {*header}:
        wrong = f"the columns {', '.join(header)}"
        if unknown or repeated:
            wrong = f"the unknown column '{unknown[0]}'" if unknown else f"the column '{repeated[0]}' twice"
        raise LogError(f"{path} has {wrong}; its first line must name {', '.join(COLUMNS)} (one of the first two)")
    for where, row in rows[1:]:
        if len(row) != len(header):
            raise LogError(f"{where} has {len(row)} columns, but the first line names {len(header)}")
        yield where, dict(zip(header, row, strict=True))


def _named(pairs: Sequence[ImagePair]) -> dict[str, list[int]]:
    """Name -> the numbers of the pairs whose left image may have it: with or without ending, after any folders."""
    found = defaultdict(list)
    for number, pair in enumerate(pairs):
        folders = pair.left.absolute().parts[1:-1]
        for name in {pair.left.name, pair.left.stem}:
            for start in range(len(folders) + 1):
                found["/".join([*folders[start:], name])].append(number)
    return found
