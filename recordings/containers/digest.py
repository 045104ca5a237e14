"""A digest that distinguishes logs by their content, without reading all of it."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

SAMPLE_BYTES = 1 << 20  # at the beginning and at the end of a file


def digest_lines(files: Iterable[Path]) -> list[str]:
    """A line for each file: its digest and its name. Raises OSError for a file that cannot be read."""
    return [f"{log_digest([file])} {file}" for file in files]


def log_digest(files: Iterable[Path]) -> str:
    """Hexadecimal digest of the size, beginning and end of each file of a log; names do not count.

    Raises OSError for a file that cannot be read.
    """
    digest = hashlib.blake2b(digest_size=16)
    for file in files:
        with file.open("rb") as stream:
            size = file.stat().st_size
            digest.update(f"{size} ".encode() + stream.read(SAMPLE_BYTES))
            stream.seek(max(0, size - SAMPLE_BYTES))
            digest.update(stream.read(SAMPLE_BYTES))
    return digest.hexdigest()
