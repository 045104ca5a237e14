"""ROS 1 messages, decoded by the definitions in the log, with the field names of ROS 2.

The codec is rosbags'. ROS 1 names the matrices of a CameraInfo in capitals, except in bags that were converted from
ROS 2, and has a sequence number in each header.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

from rosbags.interfaces import Nodetype

from recordings.errors import LogError
from recordings.ros2.cdr import full_name, store_of
from recordings.ros2.typestore import SharedTypestore

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_NO_FIELDS = "structure_needs_at_least_one_member"  # the only field of a type without fields, as rosbags has it


@lru_cache(maxsize=256)
def decoder_for(schema_name: str, schema_encoding: str, text: bytes) -> Callable[[bytes | memoryview], Any]:
    """Build a function from ROS 1 bytes to a message by its definition ("ros1msg").

    Raises LogError for a definition that cannot be parsed. The function raises the codec's exceptions for bytes that do
    not fit.
    """
    if schema_encoding != "ros1msg":
        raise LogError(f"schema '{schema_name}' is in '{schema_encoding}', not in ROS 1's 'ros1msg'")
    name, store = full_name(schema_name), store_of(schema_name, schema_encoding, text)
    if nothing := sorted(_listed_nothings(store)):
        raise LogError(f"schema '{schema_name}' has a list of {nothing[0]}, which has no fields, and so no end")
    if name == CAMERA_INFO:
        return lambda data: _camera_info(store.deserialize_ros1(bytes(data), name))
    return lambda data: store.deserialize_ros1(bytes(data), name)


def _listed_nothings(store: SharedTypestore) -> Iterator[str]:
    """The types without any bytes that another type has a list of."""

    def is_nothing(name: Any) -> bool:
        fields = store.fielddefs[name][1]
        return all(
            field == _NO_FIELDS or (kind == Nodetype.NAME and is_nothing(part)) for field, (kind, part) in fields
        )

    for _, fields in store.fielddefs.values():
        part: Any
        for _, (kind, part) in fields:
            if kind in (Nodetype.SEQUENCE, Nodetype.ARRAY) and part[0][0] == Nodetype.NAME and is_nothing(part[0][1]):
                yield str(part[0][1])


def _camera_info(message: Any) -> Any:
    names = (name for name in message.__dataclass_fields__ if not name.startswith("__"))
    return SimpleNamespace(**{name.lower(): getattr(message, name) for name in names})
