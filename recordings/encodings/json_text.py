"""Messages in JSON, as objects with attributes."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

from recordings.errors import LogError


def json_decoder(data: bytes | memoryview) -> Any:
    """The message of a JSON object. Raises LogError for anything else."""
    try:
        message = json.loads(bytes(data), object_hook=_object)
    except (ValueError, RecursionError) as error:
        raise LogError(f"it is not JSON ({error})") from error
    if not isinstance(message, SimpleNamespace):
        raise LogError(f"it is a JSON {type(message).__name__}, not an object")
    return message


def _object(fields: dict[str, Any]) -> SimpleNamespace:
    return SimpleNamespace(**{str(name): value for name, value in fields.items()})
