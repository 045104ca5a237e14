"""Opens what the user gives as a log: a file, several files, or the folder of a recording.

The first bytes of a file say which container it is, not its name.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path

from recordings.containers.container import Container
from recordings.containers.finding import find_files, first_bytes
from recordings.containers.recording import Recording
from recordings.containers.unpacking import unpacked
from recordings.errors import LogError
from recordings.ros2.cdr import is_packed

_CONTAINERS = (  # the first bytes of each, its module, and its class, which takes some time to import
    (b"\x89MCAP0\r\n", "mcap.file", "McapFile"),
    (b"SQLite format 3\0", "containers.db3", "Db3File"),
    (b"#ROSBAG V", "containers.ros1_bag", "Ros1Bag"),
)


def open_recording(given: Path | str | Sequence[Path | str]) -> Recording:
    """Open a file, several files or a folder as one log. Raises LogError where there is nothing to read."""
    found = find_files(given)
    with ExitStack() as stack:
        opened = list[Container]()
        for path in found.files:
            file = _open_file(path, stack)
            stack.callback(file.close)
            opened.append(file)
        close = stack.pop_all().close
    first = Path(given if isinstance(given, Path | str) else given[0])
    return Recording(first, opened, found.missing, found.part, close)


def _open_file(path: Path, stack: ExitStack) -> Container:
    """Open one file; a compressed one, of a folder, is unpacked first."""
    start = first_bytes(path)
    if is_packed(start):
        path = unpacked(path, stack)
        start = first_bytes(path)
    for magic, home, name in _CONTAINERS:
        if start.startswith(magic):
            container: Container = getattr(import_module(f"recordings.{home}"), name)(path)
            return container
    raise LogError(f"{path} is not an MCAP log, a rosbag2 database or a ROS 1 bag (its first bytes differ); give a log")
