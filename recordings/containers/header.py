"""Reads the stamp of a message that begins with a std_msgs/Header, without decoding the message."""

from __future__ import annotations

import re
import struct

import zstandard

from recordings.containers.container import Channel
from recordings.ros2.cdr import plain, standard_types

_STAMP_END = 12  # bytes of a message up to the end of its header's stamp
# The time of Foxglove's messages is in the same place.
_HEADER_FIRST = re.compile(
    rb"\A(?:\s|#[^\n]*\n)*"
    rb"(?:(?:std_msgs/(?:msg/)?)?Header\s+header|(?:builtin_interfaces/(?:msg/)?)?Time\s+timestamp)\b"
)
_ANNOTATION = rb'@\w+\s*(?:\((?:"(?:[^"\\]|\\.)*"|[^")])*\))?\s*'  # a comment has several lines
_HEADER_FIRST_IDL = re.compile(rb"struct \w+ \{\s*(?:" + _ANNOTATION + rb")*std_msgs::msg::Header_?\s+header\b")


def begins_with_header(channel: Channel) -> bool:
    """Whether the schema of a channel says that its messages begin with a std_msgs/Header, or with a time."""
    schema = channel.schema
    if schema is None or channel.message_encoding not in ("cdr", "ros1"):
        return False
    if not schema.text.strip() and schema.name in standard_types().types:
        return "header" in [name for name, _ in standard_types().fielddefs[schema.name][1][:1]]
    pattern = _HEADER_FIRST_IDL.search if schema.encoding == "ros2idl" else _HEADER_FIRST.match
    return pattern(schema.text[:100_000].replace(b"\r\n", b"\n")) is not None


def peek_stamp(data: bytes | memoryview, message_encoding: str = "cdr") -> int:
    """The stamp of a CDR or ROS 1 message that begins with a std_msgs/Header, ns; 0 if there is none."""
    if message_encoding not in ("cdr", "ros1"):
        return 0
    try:
        head = plain(data, _STAMP_END)
    except zstandard.ZstdError:
        return 0
    if len(head) < _STAMP_END:
        return 0
    # The stamp is in the same place: behind the header of CDR, or behind the sequence number of ROS 1.
    is_little = message_encoding == "ros1" or head[1]
    seconds, nanoseconds = struct.unpack_from("<iI" if is_little else ">iI", head, 4)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)
