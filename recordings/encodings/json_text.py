"""Messages in JSON, as objects with attributes."""

from __future__ import annotations

import json
import re
from types import SimpleNamespace
from typing import Any

from recordings.errors import LogError

# Of a message; they take far more memory than their text. What is counted may also be in strings.
_MAX_COUNTS = {"values": (",[", 4_000_000), "objects": ("{", 100_000), "names": (":", 400_000)}
_SURROGATE = re.compile(rb"\\u[dD][89a-fA-F]")


def json_decoder(data: bytes | memoryview) -> Any:
    """The message of a JSON object. Raises LogError for anything else."""
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
