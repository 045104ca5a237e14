"""Opens what the user gives as a log: a file, several files, or the folder of a recording.

The first bytes of a file say which container it is, not its name.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path

from recordings.containers.container import Container
from recordings.containers.finding import find_files
from recordings.containers.recording import Recording
from recordings.containers.unpacking import ZSTD_MAGIC, unpacked
from recordings.errors import LogError, sentence_of

_CONTAINERS = (  # the first bytes of each, its module, and its class, which takes some time to import
    (b"\x89MCAP0\r\n", "mcap.file", "McapFile"),
    (b"SQLite format 3\0", "containers.db3", "Db3File"),
    (b"#ROSBAG V", "containers.ros1_bag", "Ros1Bag"),
)


def open_recording(given: Path | Sequence[Path]) -> Recording:
    """Open a file, several files or a folder as one log. Raises LogError where there is nothing to read."""
    found = find_files(given)
    with ExitStack() as stack:
        opened = list[Container]()
        for path in found.files:
            file = _open_file(path, stack)
            stack.callback(file.close)
            opened.append(file)
        path = given if isinstance(given, Path) else given[0]
        return Recording(path, opened, found.missing, found.part, stack.pop_all().close)
    raise AssertionError


def _open_file(path: Path, stack: ExitStack) -> Container:
    """Open one file; a compressed one, of a folder, is unpacked first."""
    start = _first_bytes(path)
    if start.startswith(ZSTD_MAGIC):
        path = unpacked(path, stack)
        start = _first_bytes(path)
    if (opened := _container_of(start)) is not None:
        return opened(path)
    if not start:
        raise LogError(f"{path} is empty (0 bytes); record it again")
    raise LogError(f"{path} is not an MCAP log, a rosbag2 database or a ROS 1 bag (its first bytes differ); give a log")


def _container_of(start: bytes) -> Callable[[Path], Container] | None:
    """The class of a container by the first bytes of its file."""
    for magic, home, name in _CONTAINERS:
        if start.startswith(magic):
            return getattr(import_module(f"recordings.{home}"), name)  # type: ignore[no-any-return]
    return None


def _first_bytes(path: Path) -> bytes:
    if path.exists() and not path.is_file():
        raise LogError(f"{path} is a pipe or a device; give a log")
    try:
        with path.open("rb") as file:
            return file.read(16)
    except OSError as error:
        raise LogError(f"cannot read {path}: {error.strerror or sentence_of(error)}") from error
