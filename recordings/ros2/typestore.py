"""rosbags' store of message types, for several threads, with codecs that are built on first use.

rosbags builds sixteen functions for each type: both byte orders, ROS 1, and conversions between them. A log needs one
or two, and building all takes most of the time in which it is opened.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import RLock
from typing import Any

from rosbags.serde import cdr, ros1
from rosbags.typesys.base import normalize_fieldname
from rosbags.typesys.store import Typestore

REGISTERING = RLock()  # rosbags builds classes and codecs in module-wide state

_BUILDERS: dict[str, Callable[[Any, Typestore], Any]] = {
    "serialize_cdr_le": lambda fields, store: cdr.generate_serialize_cdr(fields, store, "le"),
    "serialize_cdr_be": lambda fields, store: cdr.generate_serialize_cdr(fields, store, "be"),
    "deserialize_cdr_le": lambda fields, store: cdr.generate_deserialize_cdr(fields, store, "le"),
    "deserialize_cdr_be": lambda fields, store: cdr.generate_deserialize_cdr(fields, store, "be"),
    "serialize_ros1": ros1.generate_serialize_ros1,
    "deserialize_ros1": ros1.generate_deserialize_ros1,
}
_SIZES: dict[str, Callable[[Any, Typestore], tuple[Any, int]]] = {
    "cdr": cdr.generate_getsize_cdr,
    "ros1": ros1.generate_getsize_ros1,
}


class LazyMsgdef:
    """The codec of a type, in place of rosbags' Msgdef: each function is built when it is first asked for."""

    def __init__(self, store: Typestore, name: str) -> None:
        self.name, self.cls, self._store = name, store.types[name], store
        self.fields = [(normalize_fieldname(field), kind) for field, kind in store.fielddefs[name][1]]

    def __getattr__(self, function: str) -> Any:
        form = function.removeprefix("get").removeprefix("size_")
        with REGISTERING:
            if function in _BUILDERS:
                self.__dict__[function] = _BUILDERS[function](self.fields, self._store)
            elif form in _SIZES:
                found = _SIZES[form](self.fields, self._store)
                self.__dict__[f"getsize_{form}"], self.__dict__[f"size_{form}"] = found
            else:
                raise AttributeError(function)  # conversions between ROS 1 and CDR are not used
        return self.__dict__[function]


class SharedTypestore(Typestore):
    """A type store for several threads."""

    def get_msgdef(self, typename: str) -> Any:
        """The codec of a type."""
        cache: dict[str, Any] = self.cache
        if typename not in cache:
            cache[typename] = LazyMsgdef(self, typename)
        return cache[typename]
