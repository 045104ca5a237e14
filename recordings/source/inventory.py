"""What a log holds, for `roverflow info`: topics, rates and gaps, calibration, transforms, how many frames would pair
up, how much of the traverse has a tilt, what is missing and what is damaged."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flow.contracts import counted
from recordings.mcap.index import Lost
from recordings.source.cameras import CAMERAS
from recordings.source.log import McapLog
from recordings.source.topics import peek_stamp
from stages.data import StereoCamera, Tilt

Stamps = NDArray[np.int64]


def describe(log: McapLog, slop: int = 5_000_000, max_gap: int | None = 200_000_000) -> dict[str, Any]:
    """The inventory of a log, as plain JSON values.

    slop: largest difference between the stamps of the two images of a frame, ns; max_gap: largest distance between the
    tilts around a frame, ns, None: they are not counted. Only stamps count here: a run waits for none that is logged
    too late.
    """
    opening, lost = log.opening, log.file.index.lost
    damage = sorted({item.reason for item in lost} | {str(problem) for _, problem in opening.problems})
    stamps = {stream: _stamps(log, stream, damage) for stream in CAMERAS}
    stamps["inclinometer"] = _tilts(log, damage)
    left, right, tilts = (_distinct(log, stream, damage, stamps[stream]) for stream in stamps)
    return {
        "path": str(log.path),
        "size_bytes": log.file.size,
        "profile": log.file.index.profile,
        "indexed": not log.file.index.walked,
        "start": log.file.start,
        "end": log.file.end,
        "duration_s": (log.file.end - log.file.start) / 1e9,
        "topics": _topics(log),
        "notes": log.notes(),
        "streams": dict(log.topics),
        "calibration": _calibration(log),
        "frames": {
            "left": len(stamps["left"]),
            "right": len(stamps["right"]),
            "pairs": _pairs(left, right, slop),
            "slop_s": slop / 1e9,
            "with_tilt": None if max_gap is None else _tilted(left, tilts, max_gap),
            "tilt_gap_s": None if max_gap is None else max_gap / 1e9,
        },
        "transforms": opening.static.listed(),
        "mount": _mount(log),
        "missing": dict(opening.lacking),
        "undecodable": opening.undecodable,
        "damage": list(dict.fromkeys(damage)),
    }


def format_description(description: dict[str, Any]) -> str:
    """The inventory as lines for a terminal."""
    d = description
    how = "indexed, its chunks are not checked" if d["indexed"] else "no index"
    lines = [f"{d['path']}: {d['duration_s']:.3f} s, {d['size_bytes'] / 1e6:.1f} MB, {how}", ""]
    rows = [("topic", "schema", "messages", "Hz", "gap", "stream")]
    roles = {topic: stream for stream, topic in d["streams"].items()}
    for topic in d["topics"]:
        hz = "" if topic["hz"] is None else f"{topic['hz']:.2f}"
        gap = "" if topic["largest_gap_s"] is None else f"{topic['largest_gap_s']:.3f} s"
        name = topic["topic"]
        rows.append((name, topic["schema"], str(topic["messages"]), hz, gap, roles.get(name, "")))
    widths = [max(len(row[column]) for row in rows) for column in range(6)]
    for row in rows:
        cells = [
            cell.rjust(w) if 2 <= n <= 4 else cell.ljust(w) for n, (cell, w) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(cells).rstrip())
    lines.append("")
    if camera := d["calibration"]:
        state = "rectified" if camera["rectified"] else "not rectified"
        lines.append(
            f"camera: {camera['width']}x{camera['height']}, fx {camera['fx']:.3f} px, "
            f"baseline {camera['baseline']:.4f} m, {state}, frame '{camera['frame_id']}'"
        )
        lines += [f"doubtful: {doubt}" for doubt in camera["doubts"]]
    if all(side in d["streams"] for side in CAMERAS):
        frames = d["frames"]
        paired = (
            f"frames: by their stamps, {counted(frames['pairs'], 'pair')} within {frames['slop_s'] * 1e3:g} ms of "
            f"{frames['left']} left and {counted(frames['right'], 'right image')}"
        )
        if frames["with_tilt"] is not None:
            gap = f"at most {frames['tilt_gap_s'] * 1e3:g} ms apart"
            paired += f"; tilts around {frames['with_tilt']} of the left ones, {gap}"
        lines.append(paired)
    if d["mount"]:
        down = "unknown" if d["mount"]["base"] is None else f"in '{d['mount']['base']}' at {d['mount']['position']}"
        lines.append(f"mount: camera {down}")
    lines += [f"transform: {transform}" for transform in d["transforms"]]
    for why in dict.fromkeys(d["missing"].values()):
        lines.append(f"missing: {', '.join(stream for stream in d['missing'] if d['missing'][stream] == why)}: {why}")
    lines += [f"note: {stream}: {said}" for stream, said in d["notes"].items()]
    lines += [d["undecodable"]] if d["undecodable"] else []
    lines += [f"damaged: {what}" for what in _grouped(d["damage"])]
    return "\n".join(lines)


def _topics(log: McapLog) -> list[dict[str, Any]]:
    index, found = log.file.index, []
    for channel in sorted(index.channels.values(), key=lambda channel: (channel.topic, channel.id)):
        schema = index.schemas.get(channel.schema_id)
        times = log.file.times({channel.id})
        gaps = np.diff(times)
        span = float(times[-1] - times[0]) / 1e9 if times.size > 1 else 0.0
        found.append(
            {
                "topic": channel.topic,
                "schema": schema.name if schema else "",
                "encoding": channel.message_encoding,
                "messages": int(times.size),
                "hz": (times.size - 1) / span if span > 0 else None,
                "largest_gap_s": float(gaps.max()) / 1e9 if gaps.size else None,
            }
        )
    return found


def _grouped(damage: list[str]) -> list[str]:
    """The sentences; of those about single messages that differ in numbers alone, how many there are, and the first."""
    groups: dict[str, list[str]] = {}
    for what in damage:
        alike = re.sub(r"(?<=[\s\[])-?\d[\d.e+-]*", "", what) if re.search(r" at \d+ ns\b", what) else what
        groups.setdefault(alike, []).append(what)
    return [f"{len(alike)} alike, first: {alike[0]}" if len(alike) > 1 else alike[0] for alike in groups.values()]


def _stamps(log: McapLog, stream: str, damage: list[str]) -> list[int]:
    """The stamps of a camera's images, ns, without decoding them; what is lost goes to `damage`."""
    if stream not in log.topics:
        return []
    topic, stamps = log.topics[stream], []
    for raw in log.file.messages(log.channels(stream)):
        if not isinstance(raw, Lost):
            stamps.append(peek_stamp(raw.data) or raw.log_time)
        elif raw.channel is not None:
            damage.append(f"{topic} at {raw.log_time} ns: {raw.reason}")
    return stamps


def _tilts(log: McapLog, damage: list[str]) -> list[int]:
    """The stamps of the tilts, ns; what cannot be read goes to `damage`."""
    stamps = []
    for _, stream, item in log.events(("inclinometer",)):
        if isinstance(item, Tilt):
            stamps.append(item.stamp)
        elif stream == "inclinometer":
            damage.append(str(item))
    return stamps


def _distinct(log: McapLog, stream: str, damage: list[str], stamps: list[int]) -> Stamps:
    """The stamps, sorted, each once; that some are repeated goes to `damage`."""
    distinct = np.unique(np.array(stamps, np.int64))
    if repeated := len(stamps) - distinct.size:
        of = f"{repeated} of {len(stamps)}"
        damage.append(f"{log.topics[stream]}: messages that repeat a stamp, which a run drops: {of}")
    return distinct


def _pairs(left: Stamps, right: Stamps, slop: int) -> int:
    """How many left images have a right one within the slop, each right image used once."""
    pairs = place = 0
    for stamp in left.tolist():
        while place < right.size and right[place] < stamp - slop:
            place += 1
        if place < right.size and right[place] <= stamp + slop:
            pairs, place = pairs + 1, place + 1
    return pairs


def _tilted(left: Stamps, tilt: Stamps, max_gap: int) -> int:
    """How many left images have the stamp of a tilt, or lie between two that are close enough to interpolate."""
    if not tilt.size:
        return 0
    after = np.searchsorted(tilt, left)
    inside = after < tilt.size
    later = tilt[np.minimum(after, tilt.size - 1)]
    earlier = tilt[np.maximum(after - 1, 0)]
    return int(np.sum(inside & ((later == left) | ((after > 0) & (later - earlier <= max_gap)))))


def _calibration(log: McapLog) -> dict[str, Any] | None:
    if log.opening.cameras is None:
        return None
    left, right = log.opening.cameras
    camera = StereoCamera.from_models(left.model, right.model, left.image_frame, left.rectified)
    names = ("width", "height", "fx", "fy", "cx", "cy", "cx_right", "baseline", "frame_id")
    values = {name: getattr(camera, name) for name in names}
    return values | {"rectified": left.rectified, "doubts": list(camera.doubts)}


def _mount(log: McapLog) -> dict[str, Any] | None:
    mount = log.opening.mount
    if mount is None:
        return None
    base = mount.base_from_camera
    return {
        "camera_from_inclinometer": mount.camera_from_inclinometer.tolist(),
        "base": None if base is None else base.parent,
        "position": None if base is None else base.translation.tolist(),
    }
