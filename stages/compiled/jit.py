"""How kernels are compiled: `kernel` for functions that Python calls, `part` for functions that only kernels call.

numba keeps the machine code of a kernel between runs as long as the file that defines it is unchanged. But a kernel
contains the code of the functions it calls, which may be in other files, and a change there would leave old code in
use. Therefore a kernel is compiled again when any source of its family changes. The families are the kernels of all
stages, and the loops of each folder of `recordings`. numba itself compares the processor.
"""

from __future__ import annotations

import errno
import functools
import hashlib
import logging
import pickle
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import llvmlite
import numba
from numba import njit
from numba.core import caching, event
from numba.core.caching import CacheImpl, IndexDataCacheFile, _CacheLocator

STAGES = Path(__file__).resolve().parent.parent
PACKAGES = ("stages", "recordings")
KERNEL_FOLDERS = {"kernels", "compiled", "data"}  # of the stages; the codes of the data types are compiled in
Function = TypeVar("Function", bound=Callable[..., Any])
log = logging.getLogger(__name__)
log.setLevel(logging.INFO)  # one line in the life of an installation: shown even where only errors are


@functools.cache
def digest(folder: Path) -> str:
    """Hexadecimal digest of all sources that the machine code of the kernels in a folder may contain."""
    if STAGES in folder.parents:
        sources = [file for file in STAGES.rglob("*.py") if file.parent.name in KERNEL_FOLDERS]
    else:
        sources = list(folder.glob("*.py"))
    total = hashlib.sha256(f"{numba.__version__} {llvmlite.__version__}".encode())
    for file in sorted(sources):
        total.update(f"{file.relative_to(STAGES.parent)} {file.stat().st_size} ".encode() + file.read_bytes())
    return total.hexdigest()


class _KernelCacheLocator(_CacheLocator):
    """numba's usual place for a kernel of this product, with the digest of its family as the mark of its age."""

    usual: tuple[Any, ...] = tuple(CacheImpl._locator_classes)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Any:
        if py_func.__module__.partition(".")[0] not in PACKAGES:
            return None
        candidates = (locator.from_function(py_func, py_file) for locator in cls.usual)
        locator = next((candidate for candidate in candidates if candidate is not None), None)
        if locator is not None:
            locator.get_source_stamp = functools.partial(digest, Path(py_file).resolve().parent)
        return locator


class _KernelCacheFile(IndexDataCacheFile):
    """numba's files of a kernel. A damaged or foreign file counts as missing; one that cannot be written is reported.

    numba writes an index and then the code, without a checksum: a full disk or two processes at once may leave the code
    of other sources under an index entry, and a loss of power may leave zeros. So the code is kept with its key, the
    digest of its sources and a checksum.
    """

    reported = False

    def load(self, key: Any) -> Any:
        with suppress(Exception):  # a damaged pickle fails in any way
            *kept, code = super().load(key)  # type: ignore[no-untyped-call]
            if kept == [key, self._source_stamp, zlib.crc32(code)]:
                return pickle.loads(code)  # as numba does
        return None

    def save(self, key: Any, data: Any) -> None:
        code = self._dump(data)  # type: ignore[no-untyped-call]
        try:
            super().save(key, (key, self._source_stamp, zlib.crc32(code), code))  # type: ignore[no-untyped-call]
        except OSError as error:
            if not _KernelCacheFile.reported:
                _KernelCacheFile.reported = True
                full = "free some space, or " if error.errno in (errno.ENOSPC, errno.EDQUOT) else ""
                remedy = f"{full}set NUMBA_CACHE_DIR to a folder that can be written"
                log.warning("cannot keep compiled kernels in %s: %s; %s", self._cache_path, error.strerror, remedy)

    def _load_index(self) -> Any:
        with suppress(Exception):  # likewise
            return super()._load_index()  # type: ignore[no-untyped-call]
        return {}


def _cache_file(cache_path: str, filename_base: str, source_stamp: Any) -> IndexDataCacheFile:
    """The files of a kernel, whose stamp is a digest, or of a function of another program as numba has them."""
    kind = _KernelCacheFile if isinstance(source_stamp, str) else IndexDataCacheFile
    return kind(cache_path, filename_base, source_stamp)  # type: ignore[no-untyped-call]


class _Announcement(event.Listener):
    """Reports once that the first call of a stage's kernel takes longer."""

    def __init__(self) -> None:
        self.made = False

    def on_start(self, event: Any) -> None:
        if not self.made and str(event.data["dispatcher"].py_func.__module__).startswith("stages."):
            self.made = True
            log.warning("compiling kernels, once for this machine and these settings; all of them take half a minute")

    def on_end(self, event: Any) -> None:
        pass


def install() -> None:
    """Register the cache locator, the cache file and the announcement with numba."""
    caches: Any = CacheImpl
    caching.IndexDataCacheFile = _cache_file  # type: ignore[assignment,misc]
    if _KernelCacheLocator not in caches._locator_classes:
        caches._locator_classes = [_KernelCacheLocator, *caches._locator_classes]
        event.register("numba:compile", _Announcement())  # type: ignore[no-untyped-call]


install()
_njit: Any = njit  # whose published type lacks the options on wrappers
# These release Python's lock and give inf or NaN for a division by 0. Without the entry points that nobody calls,
# compiling takes a third less time.
_CALLED: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
_INSIDE = _CALLED | {"no_cpython_wrapper": True}
kernel: Any = _njit(cache=True, **_CALLED)
part: Any = _njit(**_INSIDE)
# `part`, inlined into its callers: arrays that it takes are not counted, which pays in an inner loop.
inlined_part: Any = _njit(forceinline=True, **_INSIDE)
# The same for arithmetic without NaN and infinity, whose sums may be taken in any order; as deterministic.
fast_kernel: Any = _njit(cache=True, fastmath=True, **_CALLED)
# Inlined into its callers: of several compiled copies numba would use the first for all of them, and each copy may
# take its sums in an order of its own.
fast_part: Any = _njit(fastmath=True, forceinline=True, **_INSIDE)
# `kernel` for functions with type annotations.
typed_kernel: Callable[[Function], Function] = kernel
# The same for functions that make no arrays: counting references to the caller's arrays, as numba does by default,
# would cost a third of the time.
borrowing_kernel: Callable[[Function], Function] = _njit(nogil=True, cache=True, error_model="numpy", _nrt=False)
