"""How the simulator's loops are compiled: kept between runs, until any file of this folder changes.

numba looks at the file that defines a loop and no further, but its machine code holds that of the loops it calls. The
method's kernels are kept in the same way, by a file of their own: recordings know nothing of the method but its data.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from numba import njit
from numba.core.caching import CacheImpl, _CacheLocator

FOLDER = Path(__file__).resolve().parent
Loop = TypeVar("Loop", bound=Callable[..., Any])


@functools.cache
def digest() -> str:
    """Hexadecimal digest of the folder's sources."""
    return hashlib.sha256(b"".join(file.read_bytes() for file in sorted(FOLDER.glob("*.py")))).hexdigest()


class _Locator(_CacheLocator):
    """Where numba would keep a loop of this folder, but marked with `digest`."""

    usual: tuple[Any, ...] = tuple(CacheImpl._locator_classes)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Any:
        if Path(py_file).resolve().parent != FOLDER:
            return None
        candidates = (locator.from_function(py_func, py_file) for locator in cls.usual)
        locator = next((candidate for candidate in candidates if candidate is not None), None)
        if locator is not None:
            locator.get_source_stamp = digest
        return locator


_caches: Any = CacheImpl
_caches._locator_classes = [_Locator, *_caches._locator_classes]


_njit: Any = njit  # whose published type lacks the options
# Loops that make arrays of their own.
allocating: Callable[[Loop], Loop] = _njit(nogil=True, cache=True, error_model="numpy")
# Loops that only borrow the caller's arrays: counting references to those, as numba does unless told otherwise, would
# cost a third of the time.
borrowing: Callable[[Loop], Loop] = _njit(nogil=True, cache=True, error_model="numpy", _nrt=False)
