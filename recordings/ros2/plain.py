"""Numbers, texts, arrays and transforms as ROS 2 messages: the standard forms of what a stage of one's own returns."""

from __future__ import annotations

from typing import Any

import numpy as np

from recordings.ros2 import to_msg as ros2
from recordings.ros2.cdr import make
from stages.data import Array, Transform

_SCALARS = {bool: "std_msgs/msg/Bool", int: "std_msgs/msg/Int64", float: "std_msgs/msg/Float64"}
_LARGEST = (1 << 63) - 1


def is_image(array: Array) -> bool:
    """Whether an array is an image: (H, W), or (H, W, 3) of 8 or 16 bit; (N, 3) floats are points."""
    if array.ndim == 3:
        return array.shape[2] == 3 and array.dtype in (np.uint8, np.uint16)
    return array.ndim == 2 and not is_points(array)


def is_points(array: Array) -> bool:
    """Whether an array contains points: (N, 3) floats."""
    return array.ndim == 2 and array.shape[1] == 3 and np.issubdtype(array.dtype, np.floating)


def message_of(value: Any, stamp: int, frame_id: str) -> Any:
    """The message of a number, a str, an array or a Transform.

    Images become sensor_msgs/Image, (N, 3) floats sensor_msgs/PointCloud2, other arrays std_msgs/Float64MultiArray or
    Int64MultiArray. Raises ValueError for anything else.
    """
    if _beyond_64_bits(value):
        raise ValueError("a whole number beyond 64 bits has no standard form")
    if type(value) in _SCALARS:
        return make(_SCALARS[type(value)], data=value)
    if isinstance(value, str):
        value.encode()  # a UnicodeEncodeError is a ValueError
        return make("std_msgs/msg/String", data=str(value))
    if isinstance(value, Transform):
        return ros2.transform_stamped(value, stamp)
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        return _array_message(value, stamp, frame_id)
    shown = f"an array of {value.dtype}" if isinstance(value, np.ndarray) else f"a value of type {type(value).__name__}"
    raise ValueError(f"{shown} has no standard form")


def array_of(message: Any) -> Array:
    """The array of a sensor_msgs/Image, Float64MultiArray or Int64MultiArray of `message_of`."""
    if hasattr(message, "layout"):
        return np.array(message.data).reshape([dimension.size for dimension in message.layout.dim])
    dtype, dimensions = {name: form for form, name in ros2.IMAGE_ENCODINGS.items()}[message.encoding]
    shape = (message.height, message.width, 3)[:dimensions]
    return np.array(message.data, np.uint8).view(dtype).reshape(shape)


def _beyond_64_bits(value: Any) -> bool:
    """Whether a whole number, or one of an array, does not fit 64 bits with a sign, which the messages have."""
    if isinstance(value, np.ndarray):
        return value.dtype == np.uint64 and bool((value > _LARGEST).any())
    return isinstance(value, int) and not -_LARGEST - 1 <= value <= _LARGEST


def _array_message(array: Array, stamp: int, frame_id: str) -> Any:
    array = array.astype(array.dtype.newbyteorder("="), copy=False)
    if is_points(array):
        return ros2.float_cloud(stamp, frame_id, ("x", "y", "z"), np.ascontiguousarray(array, np.float32))
    if is_image(array):
        if array.dtype == bool:
            array = array.astype(np.uint8) * 255
        if array.dtype == np.float16:
            array = array.astype(np.float32)
        if ros2.has_encoding(array):
            return ros2.image(stamp, frame_id, array)
    name, dtype = ("Float64", np.float64) if array.dtype.kind == "f" else ("Int64", np.int64)
    dimensions = [
        make("std_msgs/msg/MultiArrayDimension", label="", size=size, stride=int(np.prod(array.shape[axis:])))
        for axis, size in enumerate(array.shape)
    ]
    layout = make("std_msgs/msg/MultiArrayLayout", dim=dimensions, data_offset=0)
    return make(f"std_msgs/msg/{name}MultiArray", layout=layout, data=np.ascontiguousarray(array, dtype).reshape(-1))
