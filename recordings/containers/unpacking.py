"""Unpacks a file that rosbag2 compressed as a whole (compression mode FILE) into a temporary folder."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

import zstandard

from recordings.errors import LogError, sentence_of

_BLOCK_BYTES = 1 << 20
_MAX_RATIO = 200  # of a recording's size to its compressed size; more is a hostile file


def unpacked(path: Path, stack: ExitStack) -> Path:
    """The unpacked file; it is deleted when the stack closes. A truncated file is unpacked as far as possible."""
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
