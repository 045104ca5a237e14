"""Messages in protobuf, by the descriptors in the log."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mcap.records import Schema

from recordings.containers.container import MessageSchema
from recordings.errors import LogError, sentence_of


def protobuf_decoder(schema: MessageSchema) -> Callable[[bytes | memoryview], Any]:
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
