"""PLY, binary little-endian: points as vertices with colours and standard deviations."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

import numpy as np

from stages.data import Array

COLORS = [("red", "u1"), ("green", "u1"), ("blue", "u1")]
_NAMES = {"<f8": "double", "<f4": "float", "|u1": "uchar"}


def write_ply(path: Path, dtype: np.dtype[np.void], parts: Iterable[Array], comment: str) -> None:
    """Write vertices.

    dtype: one property per field; parts: structured arrays (n,) of it; comment: one line of ASCII. The header contains
    the number of points, so it is filled in at the end.
    """
    with path.open("wb") as file:
        place, count = _begin(file, dtype, comment), 0
        for part in parts:
            file.write(part.tobytes())
            count += len(part)
        file.seek(place)
        file.write(f"{count:>10d}".encode())


def _begin(file: BinaryIO, dtype: np.dtype[np.void], comment: str) -> int:
    """Write the header; returns the offset of the number of points."""
    fields = [(name, _NAMES[dtype[name].str]) for name in dtype.names or ()]
    file.write(f"ply\nformat binary_little_endian 1.0\ncomment {comment}\nelement vertex ".encode("ascii", "replace"))
    place = file.tell()
    properties = "".join(f"property {kind} {name}\n" for name, kind in fields)
    file.write(f"{0:>10d}\n{properties}end_header\n".encode())
    return place
