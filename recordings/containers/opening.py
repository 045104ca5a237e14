"""Opens what the user gives as a log: a file, several files, or the folder of a recording.

The first bytes of a file say which container it is, not its name.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

from recordings.containers.container import Container
from recordings.containers.finding import find_files
from recordings.containers.recording import Recording
from recordings.containers.unpacking import ZSTD_MAGIC, unpacked
from recordings.errors import LogError, sentence_of


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
    for magic, opened in _containers().items():
        if start.startswith(magic):
            return opened(path)
    if not start:
        raise LogError(f"{path} is empty (0 bytes); record it again")
    raise LogError(f"{path} is not an MCAP log, a rosbag2 database or a ROS 1 bag (its first bytes differ); give a log")


def _containers() -> dict[bytes, Callable[[Path], Container]]:
    """The first bytes of each container, and its class."""
    from recordings.containers.db3 import Db3File
    from recordings.containers.ros1_bag import Ros1Bag
    from recordings.mcap.file import McapFile
    from recordings.mcap.index import MAGIC

    return {MAGIC: McapFile, b"SQLite format 3\0": Db3File, b"#ROSBAG V": Ros1Bag}


def _first_bytes(path: Path) -> bytes:
    if path.exists() and not path.is_file():
        raise LogError(f"{path} is a pipe or a device; give a log")
    try:
        with path.open("rb") as file:
            return file.read(16)
    except OSError as error:
        raise LogError(f"cannot read {path}: {error.strerror or sentence_of(error)}") from error
