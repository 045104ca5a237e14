"""ROS 1 messages, decoded by the definitions in the log, with the field names of ROS 2.

The codec is rosbags'. ROS 1 names the matrices of a CameraInfo in capitals and has a sequence number in each header.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

from recordings.errors import LogError
from recordings.ros2.cdr import full_name, store_of

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"


@lru_cache(maxsize=256)
def decoder_for(schema_name: str, schema_encoding: str, text: bytes) -> Callable[[bytes | memoryview], Any]:
    """Build a function from ROS 1 bytes to a message by its definition ("ros1msg").

    Raises LogError for a definition that cannot be parsed. The function raises the codec's exceptions for bytes that do
    not fit.
    """
    if schema_encoding != "ros1msg":
        raise LogError(f"schema '{schema_name}' is in '{schema_encoding}', not in ROS 1's 'ros1msg'")
    name, store = full_name(schema_name), store_of(schema_name, schema_encoding, text)
    if name == CAMERA_INFO:
        return lambda data: _camera_info(store.deserialize_ros1(bytes(data), name))
    return lambda data: store.deserialize_ros1(bytes(data), name)


def _camera_info(message: Any) -> Any:
    fields = {field: getattr(message, field) for field in message.__dataclass_fields__ if not field.startswith("__")}
    return SimpleNamespace(**fields, **{field.lower(): fields[field] for field in "DKRP"})
