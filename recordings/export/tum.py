"""Poses as TUM files, which evo and others read: stamp in seconds, x y z, and the quaternion x y z w, in a line."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from recordings.mcap.file import iter_decoded

POSE = "/nav/pose"


def tum_texts(result: Path, lost: Counter[str] | None = None) -> dict[str, str]:
    """Frame of reference -> the poses of a result log in it, as the text of a TUM file.

    lost: counts the reasons of losses in a damaged log, which is otherwise refused.
    """
    lines = dict[str, list[str]]()
    for _, stamp, message in iter_decoded(result, [POSE], lost):
        place, turn = message.pose.pose.position, message.pose.pose.orientation
        numbers = (place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w)
        seconds = f"{stamp // 1_000_000_000}.{stamp % 1_000_000_000:09d}"
        line = f"{seconds} {' '.join(f'{number:.9g}' for number in numbers)}\n"
        lines.setdefault(message.header.frame_id, []).append(line)
    return {frame_id: "".join(own) for frame_id, own in lines.items()}
