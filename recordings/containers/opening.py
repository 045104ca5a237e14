"""Opens what the user gives as a log: a file, several files, or the folder of a recording.

The first bytes of a file say which container it is, not its name.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory

import zstandard

from recordings.containers.container import Container
from recordings.containers.finding import find_files, first_bytes
from recordings.containers.recording import Recording
from recordings.errors import LogError, sentence_of
from recordings.ros2.cdr import is_packed

_CONTAINERS = (  # the first bytes of each, its module, and its class, which takes some time to import
    (b"\x89MCAP0\r\n", "mcap.file", "McapFile"),
    (b"SQLite format 3\0", "containers.db3", "Db3File"),
    (b"#ROSBAG V", "containers.ros1_bag", "Ros1Bag"),
)
_BLOCK_BYTES = 1 << 20
_MAX_RATIO = 200  # of a recording's size to its compressed size; more is a hostile file


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
        path = _unpacked(path, stack)
        start = first_bytes(path)
    for magic, home, name in _CONTAINERS:
        if start.startswith(magic):
            container: Container = getattr(import_module(f"recordings.{home}"), name)(path)
            return container
    raise LogError(f"{path} is not an MCAP log, a rosbag2 database or a ROS 1 bag (its first bytes differ); give a log")


def _unpacked(path: Path, stack: ExitStack) -> Path:
    """The file that rosbag2 compressed as a whole (compression mode FILE), unpacked into a folder that `stack` deletes.

    A truncated file is unpacked as far as possible.
    """
    folder = Path(stack.enter_context(TemporaryDirectory(prefix="roverflow-")))
    out, limit = folder / path.stem, max(path.stat().st_size, _BLOCK_BYTES) * _MAX_RATIO
    try:
        with path.open("rb") as packed, out.open("wb") as file:
            stream = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
            while block := stream.read(_BLOCK_BYTES):
                file.write(block)
                if file.tell() > limit:
                    raise LogError(f"{path} unpacks to more than {_MAX_RATIO} times its size; it is not a recording")
    except zstandard.ZstdError as error:
        if not out.stat().st_size:
            raise LogError(f"{path} cannot be unpacked ({sentence_of(error)}); copy it again") from error
    except OSError as error:
        reason = error.strerror or sentence_of(error)
        raise LogError(f"cannot unpack {path} into {folder}: {reason}; set TMPDIR to a disk with space") from error
    return out
