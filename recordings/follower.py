"""Copies a file that grows into a pipe, in a thread of its own: a slow or suspended reader delays nobody.

The file is the queue between both, so a reader that comes back gets all of it.
"""

from __future__ import annotations

import os
import threading
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

BLOCK = 1 << 16  # bytes, that a pipe holds
MAX_WAIT = 3.0  # s, for a reader that does not have the rest at the end


class Follower:
    """Copies `path`, which exists, into the file descriptor `pipe` until `finish`."""

    def __init__(self, path: Path, pipe: int) -> None:
        self._grown, self._over = threading.Event(), False
        self._thread = threading.Thread(target=self._copy, args=(path.open("rb"), os.dup(pipe)), daemon=True)
        self._thread.start()

    def grown(self) -> None:
        """Copy what the file has more."""
        self._grown.set()

    def finish(self) -> None:
        """Copy the rest of the complete file, and wait for its reader for `MAX_WAIT` at most."""
        self._over = True
        self._grown.set()
        self._thread.join(MAX_WAIT)

    def _copy(self, file: BinaryIO, pipe: int) -> None:
        with file, suppress(OSError):  # the reader has ended
            over = False
            while not over:
                self._grown.wait()
                self._grown.clear()
                over = self._over
                while block := memoryview(file.read(BLOCK)):
                    while block:
                        block = block[os.write(pipe, block) :]
        os.close(pipe)
