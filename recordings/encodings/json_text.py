"""Messages in JSON, as objects with attributes."""

from __future__ import annotations

import json
import re
from types import SimpleNamespace
from typing import Any

from recordings.errors import LogError

_MAX_VALUES, _MAX_OBJECTS = 4_000_000, 100_000  # of a message; they take far more memory than their text
_SURROGATE = re.compile(rb"\\u[dD][89a-fA-F]")


def json_decoder(data: bytes | memoryview) -> Any:
    """The message of a JSON object. Raises LogError for anything else."""
    text = bytes(data)
    if text.count(b"{") > _MAX_OBJECTS or sum(map(text.count, (b",", b"["))) > _MAX_VALUES:
        raise LogError(f"it has more than {_MAX_VALUES} values or {_MAX_OBJECTS} objects")
    try:
        message = json.loads(text, object_hook=_object)
        if _SURROGATE.search(text):  # a half of one is no character, and no output could contain it
            json.dumps(json.loads(text), ensure_ascii=False).encode()
    except (ValueError, RecursionError) as error:
        raise LogError(f"it is not JSON ({error})") from error
    if not isinstance(message, SimpleNamespace):
        raise LogError(f"it is a JSON {type(message).__name__}, not an object")
    return message


def _object(fields: dict[str, Any]) -> SimpleNamespace:
    return SimpleNamespace(**{str(name): value for name, value in fields.items()})
