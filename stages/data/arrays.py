"""Checks of what enters a data type. Arrays are read-only from then on.

Errors name the type and its field, because logs as well as stages make these types.
"""

from __future__ import annotations

import math
from dataclasses import fields, is_dataclass
from functools import cache
from numbers import Integral, Real
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import DTypeLike, NDArray

from flow.contracts import StageError, unaliased

Array = NDArray[Any]
Span = tuple[slice, slice]  # rows and columns

_TAKEN: dict[type, Any] = {  # what a field of a type may be instead; `publish` checks arrays
    int: Integral, float: Real, bool: bool | np.bool_, tuple: tuple | list | np.ndarray, np.ndarray: object,
}  # fmt: skip
_UNIT, _MAX_SKEW = np.eye(3), 1e-6 + 1e-5 * np.eye(3)  # what a rotation times its transpose may differ from the unit


def publish(owner: object, name: str, shape: tuple[int | None, ...], dtype: DTypeLike) -> None:
    """Check the array field `name` of a frozen dataclass and make it read-only; None in `shape` is any extent."""
    array = np.asarray(getattr(owner, name))
    where = f"{type(owner).__name__}.{name}"
    if array.dtype != np.dtype(dtype):
        raise StageError(f"{where} must be {np.dtype(dtype)}, not {array.dtype}")
    if array.ndim != len(shape) or any(want not in (None, have) for want, have in zip(shape, array.shape, strict=True)):
        wanted = ", ".join("n" if extent is None else str(extent) for extent in shape)
        raise StageError(f"{where} must have shape ({wanted}), not {array.shape}")
    object.__setattr__(owner, name, read_only(array))


def publish_image(owner: object, name: str) -> None:
    """Check that field `name` is a gray (H, W) or RGB (H, W, 3) image of 8 or 16 bit, and make it read-only."""
    pixels = np.asarray(getattr(owner, name))
    if pixels.dtype not in (np.uint8, np.uint16):
        raise StageError(f"{type(owner).__name__}.{name} must be uint8 or uint16, not {pixels.dtype}")
    if pixels.ndim != 2 and pixels.shape[2:] != (3,):
        raise StageError(f"{type(owner).__name__}.{name} must be (H, W) gray or (H, W, 3) RGB, not {pixels.shape}")
    publish(owner, name, pixels.shape, pixels.dtype)


def publish_vector(owner: object, name: str, shape: tuple[int, ...], finite: bool = True) -> None:
    """Replace a small array-like by a read-only float64 copy."""
    values = np.array(getattr(owner, name), dtype=np.float64)
    if finite and not np.isfinite(values).all():
        raise StageError(f"{type(owner).__name__}.{name} must be finite, not {values.tolist()}")
    if values.shape != shape:
        wanted = ", ".join(map(str, shape))
        raise StageError(f"{type(owner).__name__}.{name} must have shape ({wanted}), not {values.shape}")
    object.__setattr__(owner, name, read_only(values))


def publish_plain(owner: Any) -> None:
    """Check the fields that are no arrays by their annotations, and make `stamp`, whole nanoseconds, an int."""
    if not isinstance(owner.stamp, Integral):
        raise StageError(f"{type(owner).__name__}.stamp must be whole nanoseconds, not {owner.stamp!r}")
    object.__setattr__(owner, "stamp", int(owner.stamp))
    for name, (wanted, taken) in _kinds(owner.__class__).items():
        if not isinstance(value := getattr(owner, name), taken):
            raise StageError(f"{type(owner).__name__}.{name} must be a {wanted}, not a {type(value).__name__}")


@cache
def _kinds(owner: type) -> dict[str, tuple[str, tuple[Any, ...]]]:
    """The type of each field of a data type by name, and what it may be; also for a class made from a data type."""
    base, found = next(own for own in reversed(owner.__mro__) if is_dataclass(own)), {}
    hints = {name: unaliased(hint) for name, hint in get_type_hints(base).items()}
    for name in (known.name for known in fields(base) if known.init):
        parts = get_args(hints[name]) if isinstance(hints[name], UnionType) else (hints[name],)
        kind, *others = (get_origin(part) or part for part in parts)
        wanted = f"{kind.__module__.partition('.')[0]}.{kind.__name__}".removeprefix("builtins.")
        found[name] = wanted, (_TAKEN.get(kind, kind), *others)
    return found


def check_resolution(owner: Any) -> None:
    """Raise ValueError unless the field `resolution`, the size of a cell, is a length."""
    if not 0 < owner.resolution < math.inf:
        raise StageError(f"{type(owner).__name__}.resolution must be positive and finite, not {owner.resolution} m")


def read_only(array: Array) -> Array:
    """A read-only view. An array that owns its memory becomes read-only itself; the base of a view does not."""
    if array.flags.owndata:
        array.flags.writeable = False
    view = array.view()
    view.flags.writeable = False
    return view


def rows_of(array: Array, which: Array) -> Array:
    """The rows of an array (n,) or (n, k) at a mask (n,) bool or at indices (m,).

    Neighbouring rows of a mask are copied at once, as bytes, which is several times faster than row by row.
    """
    if array.ndim == 1:
        return np.asarray(array[which])
    raw = np.ascontiguousarray(array).view(np.dtype((np.void, array.itemsize * array.shape[1])))
    return np.asarray(raw.reshape(-1)[which].view(array.dtype).reshape(-1, array.shape[1]))


def check_rotation(rotation: Array, where: str) -> None:
    """Raise ValueError unless a (3, 3) matrix is orthonormal and right-handed."""
    if not np.all(np.abs(rotation @ rotation.T - _UNIT) <= _MAX_SKEW) or np.linalg.det(rotation) < 0:
        raise StageError(f"{where} is not a rotation matrix")


def spanned(cells: Array, margin: int = 0) -> Span:
    """The rows and columns of the True cells of a mask, and `margin` more on each side; of the first cell if none is.

    The end of a span may lie beyond the mask.

    Examples
    --------
    >>> spanned(np.array([[False, False], [False, True]]))
    (slice(1, 2, None), slice(1, 2, None))
    """
    places = [np.flatnonzero(cells.any(axis)) for axis in (1, 0)]
    ends = [(int(at[0]), int(at[-1])) if len(at) else (0, 0) for at in places]
    rows, cols = (slice(max(first - margin, 0), last + 1 + margin) for first, last in ends)
    return rows, cols
