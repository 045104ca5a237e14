"""Poses as a TUM file, which evo and others read: stamp in seconds, x y z, and the quaternion x y z w, in a line."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from recordings.mcap.file import iter_decoded

POSE = "/nav/pose"


def write_tum(result: Path, path: Path, lost: Counter[str] | None = None) -> list[Path]:
    """Write the poses of a result log; returns the file, or nothing if the log has no poses.

    lost: counts the reasons of losses in a damaged log, which is otherwise refused.
    """
    lines = []
    for _, stamp, message in iter_decoded(result, [POSE], lost):
        place, turn = message.pose.pose.position, message.pose.pose.orientation
        numbers = (place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w)
        seconds = f"{stamp // 1_000_000_000}.{stamp % 1_000_000_000:09d}"
        lines.append(f"{seconds} {' '.join(f'{number:.9g}' for number in numbers)}\n")
    if not lines:
        return []
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(lines))
    return [path]
