"""Copies a file that grows into a pipe, in a thread of its own: a slow or suspended reader holds up nobody.

The file is the queue between both, so a reader that comes back gets all of it.
"""

from __future__ import annotations

import os
import threading
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

BLOCK = 1 << 16  # bytes, that a pipe holds
PATIENCE = 3.0  # s, that a reader has at the end for the rest


class Follower:
    """Copies `path`, which exists, into the file descriptor `pipe` until `finish`."""

    def __init__(self, path: Path, pipe: int) -> None:
        self._grown, self._over = threading.Event(), False
        self._thread = threading.Thread(target=self._copy, args=(path.open("rb"), os.dup(pipe)), daemon=True)
        self._thread.start()

    def grown(self) -> None:
        """The file has grown."""
        self._grown.set()

    def finish(self) -> None:
        """The file is complete. Waits until the reader has it, but not for long."""
        self._over = True
        self._grown.set()
        self._thread.join(PATIENCE)

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
