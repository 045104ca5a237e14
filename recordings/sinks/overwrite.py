"""Recognises earlier outputs of roverflow, which a new output may replace, by their content."""

from __future__ import annotations

import json
import struct
from pathlib import Path

from recordings.errors import UnwritableError

_HEADERS = tuple(  # with profile, ROS 2 or none, and library
    b"\x89MCAP0\r\n\x01"
    + struct.pack("<QI", 17 + len(profile), len(profile))
    + profile
    + struct.pack("<I9s", 9, b"roverflow")
    for profile in (b"ros2", b"")
)
_ABOUT = 12, struct.pack("<I9s", 9, b"roverflow")  # the metadata record that follows it in result logs, and its name
_RECORDING = b"RRF", b"/summary", b"# RUNNING"  # its magic, and its first summary
_DESK = b"roverflow"  # the application of layouts
_DIFFERENCE = b"roverflow_diff"  # the application of recordings of differences
PICTURE = b"Software\x00roverflow"  # the text chunk of its PNG files
REPORT = "<!-- roverflow report -->"  # the second line of its HTML files
_BEGINNING = 1 << 18  # bytes that contain these
_KEYS = {
    "summary": {"frames_in", "verdict"},
    "score": {"frames", "compared", "missing", "unmatched"},
    "scores": {"fleet", "pipelines"},
}


def is_ours(path: Path, kind: str) -> bool:
    """Whether the file `path` is an earlier output of roverflow of that kind, or empty, so that another may replace it.

    kind: "input log", as simulator and imports make them, "result log", "recording", "desk", "difference", "picture",
    "report", "summary", "score" or "scores", of a fleet.
    """
    with path.open("rb") as file:
        start = file.read(_BEGINNING)
    if not start:
        return True
    if kind in _KEYS:
        return start.startswith(b"{") and _has_keys(path, _KEYS[kind])
    if kind == "recording":
        return start.startswith(_RECORDING[0]) and all(mark in start for mark in _RECORDING)
    if kind == "report":
        return REPORT.encode() in start
    if kind == "picture":
        return start.startswith(b"\x89PNG") and PICTURE in start
    if kind == "difference":
        return start.startswith(_RECORDING[0]) and _DIFFERENCE in start
    if kind == "desk":
        return start.startswith(_RECORDING[0]) and _DESK in start and _RECORDING[1] not in start
    code, name = _ABOUT
    header = next((known for known in _HEADERS if start.startswith(known)), None)
    if header is None:
        return False
    follows = start[len(header) :]
    result = follows[:1] == bytes([code]) and follows[9:].startswith(name)  # 8 bytes between them are its length
    return result == (kind == "result log")


def refuse_foreign(path: Path, kind: str) -> None:
    """Raise UnwritableError for a file that no earlier run wrote, such as the log that is read."""
    if Path(path).is_file() and not is_ours(Path(path), kind):
        raise UnwritableError(f"cannot write {path}: it exists and is not a roverflow {kind}; choose another name")


def _has_keys(path: Path, keys: set[str]) -> bool:
    """Whether a file is a JSON object with these keys."""
    try:
        value = json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        return False
    return isinstance(value, dict) and keys <= value.keys()
