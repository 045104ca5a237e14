"""Reads the files of data sets: tables as text, stamps without rounding, and images as they are."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from datetime import datetime
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from flow.contracts import counted
from recordings.errors import LogError
from recordings.ros2.cdr import LAST_STAMP
from recordings.ros2.image_from_msg import stated_size, unpacked_pixels
from stages.data import Array, StereoCamera

ENCODED = {b"\x89PNG": "png", b"\xff\xd8\xff": "jpeg"}  # first bytes of the files that a log contains unchanged
MAX_ROUNDING = 0.01  # of the length of a quaternion
_TIME = re.compile(r"(\d{4})[-_](\d\d)[-_](\d\d)[ T_](\d\d)[:_](\d\d)[:_](\d\d)(?:[._](\d{1,9}))?(Z|[-+]\d\d:?\d\d)?$")


def read_bytes(path: Path) -> bytes:
    """The content of a file. Raises LogError."""
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise LogError(f"cannot read {path}: {error.strerror or error}") from error


def read_lines(path: Path, listed: bool = False) -> Iterator[tuple[str, str]]:
    """Each line with content of a text file, after its place in words; without comments (# and %).

    listed: the lines are of images by number, so one without content between them is an error. Raises LogError.
    """
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise LogError(f"{path} is not a text file; correct it or get it again") from error
    gap, begun = 0, False
    for number, line in enumerate(text.splitlines(), 1):
        if (content := line.strip()) and content[0] not in "#%":
            if listed and gap:
                raise LogError(
                    f"{path}, line {gap} is empty or a comment, but lines are counted as images are; fill or remove it"
                )
            begun = True
            yield f"{path}, line {number}", content
        elif begun or not content:
            gap = gap or number


def read_rows(
    path: Path, columns: int, separator: str | None = None, listed: bool = False
) -> Iterator[tuple[str, list[str]]]:
    """The columns of each line, as of `read_lines`; separator: None is blanks. Raises LogError for too few."""
    for where, line in read_lines(path, listed):
        row = [value.strip() for value in line.rstrip(f"{separator or ''} ").split(separator)]
        if len(row) < columns:
            raise LogError(f"{where} has only {len(row)} of {columns} columns; correct it or get it again")
        yield where, row


def firsts(rows: Iterable[tuple[Any, Any]], what: str, where: str, notes: list[str]) -> dict[Any, Any]:
    """Key -> value of rows, the first one of each key. A note counts the others. what: the keys in words."""
    found, repeated = dict[Any, Any](), []
    for key, value in rows:
        if key in found:
            repeated.append(key)
        found.setdefault(key, value)
    if repeated:
        rest = counted(len(repeated), "row")
        notes.append(f"{where} has {rest} whose {what} is in a row before, first: {repeated[0]}; left out")
    return found


def numbers_of(values: list[str], where: str) -> Array:
    """The values as float64. Raises LogError if one is not a finite number."""
    try:
        if grouped := [value for value in values if "_" in value]:  # float() takes 1_4 for 14
            raise ValueError(grouped[0])
        found = np.array([float(value) for value in values])
    except ValueError as error:
        raise LogError(f"{where} contains what is not a number ({error}); correct it or get it again") from error
    if not np.isfinite(found).all():
        raise LogError(f"{where} contains a number that is not finite; correct it or get it again")
    return found


def rotation_of(quaternion: Array, where: str) -> Rotation:
    """The rotation of a quaternion x, y, z, w. Raises LogError unless its length is 1."""
    if not abs((length := float(np.linalg.norm(quaternion))) - 1) <= MAX_ROUNDING:
        raise LogError(f"{where} has a quaternion of the length {length:g}; correct it or get it again")
    return Rotation.from_quat(quaternion)


def nanoseconds(text: str, where: str) -> int:
    """A stamp in whole nanoseconds. Raises LogError, also for one that a spreadsheet rounded (1.40363E+18)."""
    if not text.isdecimal():
        rounded = re.fullmatch(r"[\d.,]+[eE]\+?\d+", text)
        remedy = "spreadsheets round stamps, so download it again" if rounded else "write such as 1403636579763555584"
        raise LogError(f"{where} has the stamp '{text}', not whole nanoseconds since 1970; {remedy}")
    return in_ros_time(int(text[:30]), text, where)


def from_seconds(text: str, where: str, start: int = 0) -> int:
    """A stamp in ns of decimal seconds after `start`, ns. Raises LogError."""
    try:
        if not abs(seconds := Decimal(text)) < LAST_STAMP:
            raise OverflowError
        stamp = start + int((seconds * 1_000_000_000).to_integral_value())
    except (ArithmeticError, ValueError) as error:
        raise LogError(f"{where} has the time '{text}', not seconds; correct it or get it again") from error
    return in_ros_time(stamp, text, where)


def from_date(text: str, where: str) -> int:
    """A stamp in ns of a date with time, parted by `-`, `:`, `.`, `T`, blanks or `_`; UTC without a zone.

    >>> from_date("1970-01-02 00:00:00.000000001", "")
    86400000000001
    """
    found = _TIME.match(text)
    try:
        if found is None:
            raise ValueError
        *parts, fraction, zone = found.groups()
        offset = datetime.strptime(zone or "Z", "%z").tzinfo
        moment = datetime(*map(int, parts), tzinfo=offset)  # type: ignore[arg-type, misc]
    except ValueError as error:
        raise LogError(f"{where} has the time '{text}', not a date and time; correct it or get it again") from error
    return in_ros_time(int(moment.timestamp()) * 1_000_000_000 + int((fraction or "0").ljust(9, "0")), text, where)


def in_ros_time(stamp: int, text: str, where: str) -> int:
    """A stamp, ns, written as `text`. Raises LogError where ROS cannot express it."""
    if not 0 < stamp < LAST_STAMP:
        raise LogError(f"{where} has the time '{text}', which is not between 1970 and 2038; correct it")
    return stamp


def encoding_of(content: bytes) -> str:
    """ "png" or "jpeg" for the bytes of such an image file, else empty."""
    return next((name for start, name in ENCODED.items() if content.startswith(start)), "")


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file, px. Raises LogError."""
    if path.is_fifo():  # which would be waited for
        raise LogError(f"{path} is a pipe, not an image")
    if size := stated_size(read_bytes(path)):
        return size
    height, width = read_pixels(path).shape[:2]
    return width, height


def read_pixels(path: Path) -> Array:
    """Gray or RGB pixels of an image file. Raises LogError."""
    pixels = unpacked_pixels(np.frombuffer(read_bytes(path), np.uint8))
    if pixels is None:
        raise LogError(f"{path} is not a readable image of 8 or 16 bit")
    return pixels


def of_size(truth: Array, camera: StereoCamera, path: Path) -> Array:
    """The truth of a file, if it has the size of the images. Raises LogError."""
    if truth.shape != (camera.height, camera.width):
        size = f"{truth.shape[1]}x{truth.shape[0]}"
        raise LogError(f"{path} is {size}, but the images are {camera.width}x{camera.height}; use files of one size")
    return truth
