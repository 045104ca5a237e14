"""Files that are whole or not there: one grows under a temporary name and takes its own when it is finished.

A temporary name belongs to one writer, so two that write to one path at the same time do not mix; the later one wins.
What stands under a path already tells by its content whether it is an earlier output, which another may replace.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

from recordings.errors import UnwritableError

_numbers = count()
_HEADER = b"\x89MCAP0\r\n" + struct.pack("<BQI4sI9s", 1, 21, 4, b"ros2", 9, b"roverflow")  # with profile and library
_ABOUT = 12, struct.pack("<I9s", 9, b"roverflow")  # the record of metadata that follows it in results, and its name
_RECORDING = b"RRF", b"/summary", b"# RUNNING"  # its magic, and what it says of the run before anything else
_BEGINNING = 1 << 18  # bytes, in which a recording has said so
_KEYS = {
    "summary": {"frames_in", "verdict"},
    "score": {"frames", "compared", "missing", "unmatched"},
}


def temporary_name(path: Path) -> Path:
    """A name beside `path` that no other writer has. Raises UnwritableError where no file can take the name `path`."""
    if path.is_dir():
        raise UnwritableError(f"cannot write {path}: it is a folder; give the name of a file in it")
    if path.exists() and not path.is_file():
        raise UnwritableError(f"cannot write {path}: it is a device or the like; give the name of a file")
    return path.with_name(f"{path.name}.{os.getpid()}-{next(_numbers)}.partial")


def give_name(temporary: Path, path: Path) -> None:
    """Give a finished file its name once the disk has its content. Raises OSError."""
    _settle(temporary)
    temporary.replace(path)
    _settle(path.parent)


def is_ours(path: Path, kind: str) -> bool:
    """Whether the file `path` is an earlier output of roverflow of that kind, or empty, so that another may replace it.

    kind: "input log", as simulator and imports make them, "result log", "recording", "summary" or "score".
    """
    with path.open("rb") as file:
        start = file.read(_BEGINNING)
    if not start:
        return True
    if kind in _KEYS:
        return start.startswith(b"{") and _has_keys(path, _KEYS[kind])
    if kind == "recording":
        return start.startswith(_RECORDING[0]) and all(mark in start for mark in _RECORDING)
    code, name = _ABOUT
    follows = start[len(_HEADER) :]
    result = follows[:1] == bytes([code]) and follows[9:].startswith(name)  # 8 bytes between them are its length
    return start.startswith(_HEADER) and result == (kind == "result log")


def _has_keys(path: Path, keys: set[str]) -> bool:
    """Whether a file is a JSON object with these keys."""
    try:
        value = json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        return False
    return isinstance(value, dict) and keys <= value.keys()


@contextmanager
def written(path: Path) -> Iterator[Path]:
    """A temporary name to write to; it becomes `path` at the end, or goes. Raises UnwritableError where it cannot."""
    temporary = temporary_name(path)
    try:
        with writing(path):
            yield temporary
            give_name(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """What writes the file or the folder `path`. Raises UnwritableError where it cannot."""
    try:
        yield
    except OSError as error:
        raise unwritable(path, error.strerror or str(error)) from error


def unwritable(path: Path, reason: str, kept: str = "") -> UnwritableError:
    """The error of a file that cannot be written. kept: what there is of it all the same."""
    remedy = "choose another place for the output or make room there"
    return UnwritableError(f"cannot write {path}: {reason}{kept}; {remedy}")


def _settle(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk."""
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
