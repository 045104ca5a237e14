"""How kernels are compiled: `kernel` for what Python calls, `part` for what only kernels call.

They are kept between runs. numba keeps the machine code of a kernel as long as the file that defines it is unchanged.
But a kernel contains the code of those it calls, which may be in other files, so a change there would leave old code
in use. Here every kernel is as old as the youngest of them: the mark by which numba tells whether its copy is current
is a digest of all sources of this folder and of the versions of numba and LLVM. numba adds the processor itself.
"""

from __future__ import annotations

import functools
import hashlib
import logging
from pathlib import Path
from typing import Any

import llvmlite
import numba
from numba import njit
from numba.core import event
from numba.core.caching import CacheImpl, _CacheLocator

FOLDER = Path(__file__).resolve().parent.parent  # stages/
log = logging.getLogger(__name__)
log.setLevel(logging.INFO)  # one line in the life of an installation: shown even where only errors are


def _sources() -> list[Path]:
    """The kernels of all steps, what they share, and the data types, whose codes are compiled in."""
    rooms = {"kernels", "compiled", "data"}
    return sorted(file for file in FOLDER.rglob("*.py") if file.parent.name in rooms)


@functools.cache
def digest() -> str:
    """Hexadecimal digest of all that the compiled kernels depend on."""
    total = hashlib.sha256(f"{numba.__version__} {llvmlite.__version__}".encode())
    for file in sorted(_sources()):  # the codes of `Source` are compiled in
        total.update(b"%s %d " % (str(file.relative_to(FOLDER)).encode(), file.stat().st_size) + file.read_bytes())
    return total.hexdigest()


class _KernelCacheLocator(_CacheLocator):
    """Where numba would keep a kernel of this folder, but marked with `digest`."""

    usual: tuple[Any, ...] = tuple(CacheImpl._locator_classes)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Any:
        if FOLDER not in Path(py_file).resolve().parents:
            return None
        candidates = (locator.from_function(py_func, py_file) for locator in cls.usual)
        locator = next((candidate for candidate in candidates if candidate is not None), None)
        if locator is not None:
            locator.get_source_stamp = digest
        return locator


class _Announcement(event.Listener):
    """Says, once, that the first call takes longer."""

    def __init__(self) -> None:
        self.made = False

    def on_start(self, event: Any) -> None:
        if not self.made and str(event.data["dispatcher"].py_func.__module__).startswith("stages."):
            self.made = True
            log.warning("compiling kernels for this machine and these settings, once; it takes some seconds")

    def on_end(self, event: Any) -> None:
        pass


def install() -> None:
    """Make numba keep this folder's kernels so, and announce when it compiles one."""
    caches: Any = CacheImpl
    if _KernelCacheLocator not in caches._locator_classes:
        caches._locator_classes = [_KernelCacheLocator, *caches._locator_classes]
        event.register("numba:compile", _Announcement())  # type: ignore[no-untyped-call]


install()
_njit: Any = njit  # whose published type lacks the options on wrappers
# No Python lock while they run, no exceptions for a division by 0; without the entry points that nobody calls, a third
# of the time to compile is saved.
kernel: Any = _njit(nogil=True, cache=True, error_model="numpy", no_cfunc_wrapper=True)
part: Any = _njit(nogil=True, error_model="numpy", no_cfunc_wrapper=True, no_cpython_wrapper=True)
# The same for arithmetic in which no NaN or infinity occurs and sums may be taken in any order; as deterministic.
fast_kernel: Any = _njit(nogil=True, cache=True, error_model="numpy", no_cfunc_wrapper=True, fastmath=True)
# Inlined into its callers: of several compiled copies the one that came first stands in for the others, and each may
# take its sums in an order of its own.
fast_part: Any = _njit(
    nogil=True, error_model="numpy", no_cfunc_wrapper=True, no_cpython_wrapper=True, fastmath=True, forceinline=True
)
