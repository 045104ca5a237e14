"""Writes files that are complete or absent: a file is written under a temporary name and renamed when it is finished.

Each writer has a temporary name of its own, so two writers of one path do not mix; the later one wins.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path
from resource import RLIM_INFINITY, RLIMIT_FSIZE, getrlimit
from secrets import token_hex
from shutil import disk_usage

from recordings.errors import UnwritableError


def temporary_name(path: Path, mark: str = "") -> Path:
    """A temporary name beside `path`, unique without a mark. Raises UnwritableError if no file can have the name
    `path`."""
    if path.is_dir():
        raise UnwritableError(f"cannot write {path}: it is a folder; give a file name")
    if path.exists() and not path.is_file():
        raise UnwritableError(f"cannot write {path}: it is not a regular file; give a file name")
    return path.with_name(f"{path.name}.{mark or f'{os.getpid()}-{token_hex(4)}'}.partial")


def unfinished(path: Path) -> Iterator[Path]:
    """The files under temporary names of `path`."""
    return path.parent.glob(f"{escape(path.name)}.*.partial")


def check_writable(path: Path) -> None:
    """Raise UnwritableError if no file can be written at `path`."""
    temporary = temporary_name(path)
    with writing(path):
        temporary.touch()
        temporary.unlink()


def give_name(temporary: Path, path: Path) -> None:
    """Rename a finished file once its content is on the disk. Raises OSError."""
    _flush_to_disk(temporary)
    temporary.replace(path)
    _flush_to_disk(path.parent)


@contextmanager
def written(path: Path) -> Iterator[Path]:
    """Yield the name of an empty file beside `path`; rename it at the end, or delete it. Raises UnwritableError."""
    temporary = temporary_name(path)
    try:
        with writing(path):
            temporary.touch()  # rerun's writers raise a RuntimeError of their own where they cannot
            yield temporary
            give_name(temporary, path)
    finally:
        with suppress(OSError):  # nothing was written
            temporary.unlink(missing_ok=True)


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn an OSError while writing `path` into an UnwritableError."""
    try:
        yield
    except OSError as error:
        raise unwritable(path, error.strerror or str(error)) from error


def unwritable(path: Path, reason: str, kept: str = "") -> UnwritableError:
    """The error for a file that cannot be written. kept: a note about what was kept."""
    too_long = reason == os.strerror(errno.ENAMETOOLONG)
    remedy = "choose a shorter name" if too_long else "choose another folder for the output or free disk space"
    return UnwritableError(f"cannot write {path}: {reason}{kept}; {remedy}")


def room_to_grow(file: Path) -> int:
    """How many bytes a file may still grow, by the disk's free space and the process' limit."""
    free, (allowed, _) = disk_usage(file.parent).free, getrlimit(RLIMIT_FSIZE)
    if allowed == RLIM_INFINITY:
        return free
    return min(free, allowed - (file.stat().st_size if file.exists() else 0))


def _flush_to_disk(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk."""
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
