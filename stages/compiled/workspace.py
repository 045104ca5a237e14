"""Memory that kernels work in, kept from one call to the next: the operating system hands out fresh pages slowly, and
takes them back whenever a large array is freed."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from stages.data import Array


class Workspace:
    """Memory of one call, kept for the next."""

    def __init__(self) -> None:
        self.whole = np.empty(0, np.uint8)
        self.used = 0

    def reserve(self, size: int) -> None:
        """Have `size` bytes ready; what was handed out before is free again."""
        if self.whole.size < size:
            self.whole = np.empty(0, np.uint8)  # the old memory goes before the new comes
            self.whole = np.empty(size, np.uint8)
        self.used = 0

    def bytes(self, size: int) -> Array:
        """Bytes with arbitrary content, on a 64-byte boundary of the workspace."""
        start = self.used + -(self.whole.ctypes.data + self.used) % 64
        self.used = start + size
        if self.used > self.whole.size:
            raise MemoryError("the kernels' workspace is too small")
        return self.whole[start : self.used]

    def array(self, shape: tuple[int, ...], kind: Any) -> Array:
        """An array with arbitrary content; takes up to 63 bytes more than it holds."""
        size = int(np.prod(shape)) * np.dtype(kind).itemsize
        items: Array = self.bytes(size).view(kind)
        return items.reshape(shape)


class Workspaces:
    """As many workspaces as calls run at once."""

    def __init__(self) -> None:
        self.idle: list[Workspace] = []
        self.lock = threading.Lock()

    @contextmanager
    def one(self) -> Iterator[Workspace]:
        """A workspace for one call; one that another call has left, where there is any."""
        with self.lock:
            space = self.idle.pop() if self.idle else Workspace()
        try:
            yield space
        finally:
            with self.lock:
                self.idle.append(space)
