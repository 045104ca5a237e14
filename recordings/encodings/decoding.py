"""Builds the decoder of a channel by its message encoding: CDR, ROS 1, protobuf or JSON.

Every decoder returns messages with the fields of a ROS 2 type. Foxglove's messages become those of ROS 2; a message of
another type keeps its own fields.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from mcap.records import Schema

from recordings.containers.container import Channel, MessageSchema
from recordings.discovery.roles import IMAGES
from recordings.encodings.foxglove import adapter_of, with_header
from recordings.errors import LogError, sentence_of
from recordings.mcap.chunk import MAX_CHUNK_BYTES, Unpacking
from recordings.ros1.codec import decoder_for as ros1_decoder
from recordings.ros2.cdr import decoder_for as cdr_decoder
from recordings.ros2.cdr import full_name, is_packed, plain

MAX_SCHEMA_BYTES = 1_000_000  # of all schemas of a log without comments; those in use have a fifth of it
MAX_MESSAGE_BYTES = 4_000_000  # of a message that is no image; none in use has a tenth of it
ENCODINGS = ("cdr", "ros1", "protobuf", "json")
# Of a message in JSON; they take far more memory than their text. What is counted may also be in strings.
_MAX_COUNTS = {"values": (",[", 4_000_000), "objects": ("{", 100_000), "names": (":", 400_000)}
_SURROGATE = re.compile(rb"\\u[dD][89a-fA-F]")

Decoder = Callable[[bytes | memoryview], Any]


def decoder_of(channel: Channel, unpacking: Unpacking | None = None) -> tuple[str, Decoder]:
    """The full ROS 2 name of a channel's type, and its decoder. Raises LogError if there is none.

    unpacking: that of all channels of the log.
    """
    schema, encoding = channel.schema, channel.message_encoding
    if encoding not in ENCODINGS:
        raise LogError(f"its messages are in '{encoding}', which is not supported, only {', '.join(ENCODINGS)}")
    if schema is None and encoding != "json":
        raise LogError("its messages have no schema")
    decode, name = _plain_decoder(encoding, schema), "" if schema is None else schema.name
    adapted = adapter_of(name)
    ros_name, adapt = adapted or (full_name(name), with_header if encoding in ("protobuf", "json") else None)

    limit, unpacking = MAX_CHUNK_BYTES if ros_name in IMAGES else MAX_MESSAGE_BYTES, unpacking or Unpacking()

    def decoded(data: bytes | memoryview) -> Any:
        if encoding == "cdr" and is_packed(data):
            data = unpacking.of(data, plain, limit + 1)
        if len(data) > limit:
            raise LogError(f"it has more than {limit} bytes, the limit of {ros_name}")
        return decode(data) if adapt is None else adapt(decode(data))

    return ros_name, decoded


def weight_of(schema: MessageSchema) -> int:
    """The number of bytes of a schema without comments, which determines the time to parse it."""
    is_ros = schema.encoding.startswith("ros")
    return len(re.sub(rb"#[^\n]*", b"", schema.text) if is_ros else schema.text)


def _plain_decoder(encoding: str, schema: MessageSchema | None) -> Decoder:
    """A function from bytes to a message as it is encoded."""
    if schema is None or encoding == "json":
        return json_decoder
    if encoding == "protobuf":
        return _protobuf_decoder(schema)
    codec = ros1_decoder if encoding == "ros1" else cdr_decoder
    return codec(schema.name, schema.encoding, schema.text)


def json_decoder(data: bytes | memoryview) -> Any:
    """The message of a JSON object, with attributes. Raises LogError for anything else."""
    text = bytes(data)
    for name, (marks, limit) in _MAX_COUNTS.items():
        if sum(text.count(mark.encode()) for mark in marks) > limit:
            raise LogError(f"it has more than {limit} {name}")
    try:
        message = json.loads(text, object_hook=lambda fields: SimpleNamespace(**fields))
        if _SURROGATE.search(text):  # a half of one is no character, and no output could contain it
            json.dumps(json.loads(text), ensure_ascii=False).encode()
    except (ValueError, RecursionError) as error:
        raise LogError(f"it is not JSON ({error})") from error
    if not isinstance(message, SimpleNamespace):
        raise LogError(f"it is a JSON {type(message).__name__}, not an object")
    return message


def _protobuf_decoder(schema: MessageSchema) -> Decoder:
    """A function from bytes to a protobuf message. Raises LogError for descriptors that cannot be used."""
    from mcap_protobuf.decoder import DecoderFactory  # takes long to import

    record = Schema(id=1, name=schema.name, encoding=schema.encoding, data=schema.text)
    try:
        decode = DecoderFactory().decoder_for("protobuf", record)
    except Exception as error:  # foreign descriptors may fail the library in any way
        raise LogError(f"schema '{schema.name}' cannot be used ({sentence_of(error)})") from error
    if decode is None:
        raise LogError(f"schema '{schema.name}' is in '{schema.encoding}', not in 'protobuf'")
    return lambda data: decode(bytes(data))
