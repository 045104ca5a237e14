"""Keeps freed memory in the process, and all of it in one heap: every stage of every frame allocates and frees large
arrays, fresh pages from the operating system cost a tenth of the time, and what one thread freed serves the others."""

from __future__ import annotations

import ctypes

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8  # of mallopt(3)
_KEPT = 512 << 20  # bytes that may stay free at the end of the heap
_LARGEST = 32 << 20  # bytes, the largest piece that glibc takes from the heap at all


def keep_freed_memory() -> None:
    """Have glibc keep freed memory for later, of the whole process. Elsewhere than with glibc it does nothing.

    The program calls it as it begins, before other threads do: the heaps that they have made stay. Who uses the runtime
    as a library may call it as well.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except AttributeError:
        return
    mallopt(_MMAP_THRESHOLD, _LARGEST)
    mallopt(_TRIM_THRESHOLD, _KEPT)
    mallopt(_ARENA_MAX, 1)
