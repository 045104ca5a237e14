"""Memory of kernels that is kept from one call to the next, because fresh pages of large arrays are slow."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from stages.data import Array


class Workspace:
    """Memory of one call, kept for the next. pool: where it may find a better fit."""

    def __init__(self, pool: Workspaces | None = None) -> None:
        self.pool = pool
        self.whole = np.empty(0, np.uint8)
        self.used = self.address = 0

    def reserve(self, size: int) -> None:
        """Reserve `size` bytes; arrays of earlier calls become invalid."""
        if self.pool is not None:
            self.pool.fit(self, size)
        if self.whole.size < size:
            self.whole = np.empty(0, np.uint8)  # frees the old memory before the new is taken
            self.whole = np.empty(size, np.uint8)
        self.used, self.address = 0, self.whole.ctypes.data

    def bytes(self, size: int) -> Array:
        """Bytes with arbitrary content, on a 64-byte boundary of the workspace."""
        start = self.used + -(self.address + self.used) % 64
        self.used = start + size
        if self.used > self.whole.size:
            raise MemoryError("the kernels' workspace is too small")
        return self.whole[start : self.used]

    def array(self, shape: tuple[int, ...], kind: Any) -> Array:
        """An array with arbitrary content; it takes up to 63 extra bytes."""
        size = math.prod(shape) * np.dtype(kind).itemsize
        items: Array = self.bytes(size).view(kind)
        return items.reshape(shape)


class Workspaces:
    """A pool of workspaces, one for each concurrent call."""

    def __init__(self) -> None:
        self.idle: list[Workspace] = []
        self.lock = threading.Lock()

    @contextmanager
    def one(self) -> Iterator[Workspace]:
        """A workspace for one call; an idle one if there is any."""
        with self.lock:
            space = self.idle.pop() if self.idle else Workspace(self)
        try:
            yield space
        finally:
            with self.lock:
                self.idle.append(space)

    def fit(self, space: Workspace, size: int) -> None:
        """Exchange the memory of `space` for the smallest idle one of at least `size` bytes, if that fits better.

        So small calls leave the large memory to large calls, and only concurrent large calls need it twice.
        """
        with self.lock:
            fitting = [each for each in (space, *self.idle) if each.whole.size >= size]
            best = min(fitting or self.idle, key=lambda each: each.whole.size, default=space)
            space.whole, best.whole = best.whole, space.whole
