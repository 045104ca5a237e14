"""Loads compiled kernels and slow modules beside other work, because the first use of each would wait for its own."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from typing import Any

import cv2
import numpy as np
from llvmlite.binding import ffi
from numba.core.dispatcher import Dispatcher

SLOW_MODULES = ("numpy.ma",)  # that numpy imports when a stage first takes a median


@contextmanager
def loading_kernels(*modules: str) -> Iterator[None]:
    """Load the machine code of earlier runs in a thread, for all kernels of imported stages; then import `modules`.

    Beside it, make the tables of colours.
    """
    ended = threading.Event()

    def work() -> None:
        for prepare in (import_arrays, stop_timing_locks):
            with suppress(Exception):  # numba then works as it does by default
                prepare()
        for kernel in imported_kernels():
            if ended.is_set():
                return
            with suppress(Exception):  # the first call loads or compiles it, and reports what is wrong
                load(kernel)
        for module in (*SLOW_MODULES, *modules):
            if not ended.is_set():
                with suppress(Exception):  # likewise
                    import_module(module)

    threads = [threading.Thread(target=each, name="kernels", daemon=True) for each in (make_colour_tables, work)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        ended.set()
        for thread in threads:
            thread.join()


def make_colour_tables() -> None:
    """Let OpenCV compute its tables for Lab colours, which takes a tenth of a second, and needs no lock of Python's."""
    cv2.cvtColor(np.zeros((1, 1, 3), np.uint8), cv2.COLOR_RGB2LAB)


def import_arrays() -> None:
    """Import numba's array functions without scipy.linalg, which numba imports only to see whether it is there."""
    linalg: Any = import_module("numba.np.linalg")
    found, linalg.ensure_blas = linalg.ensure_blas, lambda: None  # scipy is there: the product depends on it
    try:
        import_module("numba.np.arraymath")
    finally:
        linalg.ensure_blas = found


def stop_timing_locks() -> None:
    """Stop numba from timing each lock of LLVM, which takes a fifth of the time of loading."""
    timed = ffi.lib._lock._cblist
    for callbacks in tuple(timed):
        ffi.unregister_lock_callback(*callbacks)


def imported_kernels() -> list[Any]:
    """The kernels in all modules of stages that are imported, each once, in the order of the pipeline's stages."""
    modules = [module for name, module in sys.modules.copy().items() if name.startswith("stages.")]
    values = [value for module in modules for value in vars(module).values()]
    return list({id(value): value for value in values if isinstance(value, Dispatcher)}.values())


def compiled_now() -> bool:
    """Whether this process has compiled a kernel because none was kept."""
    return any(kernel.stats.cache_misses for kernel in imported_kernels())


def load(kernel: Any) -> int:
    """Load what numba keeps of a kernel for this processor and its present source; returns the number of versions."""
    cache = kernel._cache
    if not hasattr(cache, "_cache_file"):  # a part of kernels, which has no code of its own
        return 0
    codegen = kernel.targetctx.codegen()
    kept = [key[0] for key in cache._cache_file._load_index() if key == cache._index_key(key[0], codegen)]
    for signature in kept:
        kernel.compile(signature)
    return len(kept)
