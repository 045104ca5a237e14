"""Keeps freed memory in the process, in one heap for all threads.

Every stage of every frame allocates and frees large arrays. Fresh pages from the operating system cost a tenth of the
time, and in one heap a thread can use what another one freed.
"""

from __future__ import annotations

import ctypes

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8  # of mallopt(3)
_MAX_KEPT = 512 << 20  # bytes that may stay free at the end of the heap
_MAX_HEAP_BLOCK = 32 << 20  # bytes; the most that glibc allows


def keep_freed_memory() -> None:
    """Make glibc keep freed memory for the whole process. With another C library it does nothing.

    Call it before other threads start: heaps that they have made already stay.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except AttributeError:
        return
    mallopt(_MMAP_THRESHOLD, _MAX_HEAP_BLOCK)
    mallopt(_TRIM_THRESHOLD, _MAX_KEPT)
    mallopt(_ARENA_MAX, 1)
