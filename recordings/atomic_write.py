"""Files that are whole or not there: one grows under a temporary name and takes its own when it is finished.

A temporary name belongs to one writer, so two that write to one path at the same time do not mix; the later one wins.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

from recordings.errors import UnwritableError

_numbers = count()


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


@contextmanager
def written(path: Path) -> Iterator[Path]:
    """A temporary name to write to; it becomes `path` at the end, or goes. Raises UnwritableError where it cannot."""
    temporary = temporary_name(path)
    try:
        with writing(path):
            yield temporary
            give_name(temporary, path)
    finally:
        with suppress(OSError):  # where nothing can be written, there is nothing to clear away
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
