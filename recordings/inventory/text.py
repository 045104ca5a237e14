"""The inventory of a log as text for a terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from flow.contracts import counted
from recordings.containers.time_range import MAX_LATENESS_NS
from recordings.inventory.search_range import ROCK
from recordings.source.cameras import CAMERAS

MAX_TILT_DELAY = 0.9  # s; a run waits one second for a tilt by default (tilt.patience)


def format_description(description: dict[str, Any]) -> str:
    """Format the inventory for a terminal."""
    d = description
    how = "indexed" if d["indexed"] else "no valid index (read through)"
    lines = [f"{d['path']}: {d['duration_s']:.3f} s, {d['size_bytes'] / 1e6:.1f} MB, {how}", ""]
    lines += [f"This is a result of {d['result']}.", ""] if d["result"] else []
    lines += [
        *_table(d["topics"], {topic: f"{stream} ({d['why'][stream]})" for stream, topic in d["streams"].items()}),
        "",
    ]
    if camera := d["calibration"]:
        state = "rectified" if camera["rectified"] else "not rectified"
        lines.append(
            f"camera: {camera['width']}x{camera['height']} px, fx {camera['fx']:.3f} px, "
            f"baseline {camera['baseline']:.4f} m, {state}, frame '{camera['frame_id']}'"
        )
        lines += [f"doubtful: {doubt}" for doubt in camera["doubts"]]
    if all(side in d["streams"] for side in CAMERAS):
        lines.append(_frame_line(d["frames"], d["poses"]))
        lines += [f"doubtful: {doubt}" for doubt in (*_stamp_doubts(d["frames"]), *_pose_doubts(d))]
    if d["mount"]:
        base, position = d["mount"]["base"], [round(value, 4) for value in d["mount"]["position"] or ()]
        lines.append("mount: camera position unknown" if base is None else f"mount: camera at {position} m in '{base}'")
    lines += [f"transform: {transform}" for transform in d["transforms"]]
    if found := d["search_range"]:
        lines.append(
            f"disparities: level ground has up to {found['ground_px']:.0f} px in this view, a rock {ROCK} m high up to "
            f"{found['rock_px']:.0f} px (camera {found['height_m']:.2f} m above '{d['mount']['base']}')"
        )
        lines += [f"doubtful: {found['doubt']}"] if found["doubt"] else []
    reasons = dict.fromkeys(() if d["result"] else d["missing"].values())
    for why in reasons:
        if why in d.get("refused", ""):
            continue  # the verdict says it
        streams = ", ".join(stream for stream in d["missing"] if d["missing"][stream] == why)
        known = next((other for other in reasons if why.endswith(f": {other}")), "")  # it has a line of its own
        lines.append(f"missing: {streams}: {why.removesuffix(f': {known}')}")
    lines += [f"note: {stream}: {note}" for stream, note in d["notes"].items()]
    lines += [d["undecodable"]] if d["undecodable"] and d["undecodable"] not in d.get("refused", "") else []
    lines += [f"damaged: {damage}" for damage in d["damage"]]
    return "\n".join(lines)


def _stamp_doubts(frames: dict[str, Any]) -> Iterator[str]:
    """What is unusual about the stamps, a sentence each, with the setting for it."""
    offset = frames["pair_offset_s"]
    if offset is not None and offset > frames["slop_s"]:
        remedy = f"if they are taken at one time, --set stereo.slop={math.ceil(offset * 1e3)}ms pairs most of them"
        yield f"the stamps of left and right images differ by up to {offset * 1e3:.3g} ms; {remedy}"
    late = (frames["tilt_delay_s"] or 0) - (frames["delay_s"] or [0, 0])[1]
    corrected = f"--set source.time_offset.inclinometer={frames['tilt_offset_s'] + late:.3f}s corrects the tilts"
    if (step := frames["tilt_delay_step_s"]) >= MAX_TILT_DELAY:
        remedy = "if a clock was set, cut the log there and run each part; info then names its source.time_offset"
        yield f"the stamps of tilts jump by {step:.1f} s against their log times; {remedy}"
    if abs(late) > MAX_LATENESS_NS / 1e9 and frames["with_tilt"] == 0:
        differ = f"the stamps of tilts and images are of clocks that differ by {abs(late):.1f} s"
        yield f"{differ}; record both with one; {corrected}, if both are logged equally soon"
    elif late > MAX_TILT_DELAY:
        remedy = (
            f"if no clock is wrong, --set tilt.patience={late + 2:.0f}s makes a run wait for them; else {corrected}"
        )
        yield f"tilts arrive in the log {late:.1f} s later than images of the same stamp; {remedy}"


def _pose_doubts(d: dict[str, Any]) -> Iterator[str]:
    """What is unusual about the poses, a sentence each, with the setting for it."""
    poses, frames = d["poses"], d["frames"]
    if poses is None:
        return
    if poses["unreadable"] and not poses["readable"]:
        remedy = "--set source.odometry=visual makes a run do without them"
        yield f"no pose on {d['streams']['odometry']} can be read; {remedy}"
    late = (poses["delay_s"] or 0) - (frames["delay_s"] or [0, 0])[1]
    if poses["readable"] and abs(late) > MAX_LATENESS_NS / 1e9 and not poses["images_covered"]:
        corrected = f"--set source.time_offset.odometry={poses['offset_s'] + late:.3f}s corrects the poses"
        differ = f"the stamps of poses and images are of clocks that differ by {abs(late):.1f} s"
        yield f"{differ}; record both with one; {corrected}, if both are logged equally soon"


def _table(topics: list[dict[str, Any]], roles: dict[str, str]) -> list[str]:
    rows = [("topic", "schema", "messages", "Hz", "largest gap", "stream")]
    for topic in topics:
        hz = "" if topic["hz"] is None else f"{topic['hz']:.2f}"
        gap = "" if topic["largest_gap_s"] is None else f"{topic['largest_gap_s']:.3f} s"
        name = topic["topic"]
        rows.append((name, topic["schema"], str(topic["messages"]), hz, gap, roles.get(name, "")))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    aligned = [str.ljust, str.ljust, str.rjust, str.rjust, str.rjust, str.ljust]
    return [
        "  ".join(align(cell, width) for align, cell, width in zip(aligned, row, widths, strict=True)).rstrip()
        for row in rows
    ]


def _frame_line(frames: dict[str, Any], poses: dict[str, Any] | None) -> str:
    line = (
        f"frames: {counted(frames['pairs'], 'stereo pair')} (stamps within {frames['slop_s'] * 1e3:g} ms) from "
        f"{counted(frames['left'], 'left image')} and {counted(frames['right'], 'right image')}"
    )
    if frames["with_tilt"] is not None:
        gap = f" (readings at most {frames['tilt_gap_s'] * 1e3:g} ms apart)"
        more = f"{gap}, {frames['pairs_with_tilt']} of them in pairs" if frames["with_tilt"] else ""
        line += f"; {counted(frames['with_tilt'], 'left image')} with a tilt{more}"
    if poses is not None and poses["pairs_with_pose"] is not None:
        line += f"; {counted(poses['pairs_with_pose'], 'stereo pair')} with a pose"
    if frames["delay_s"]:
        unit, scale, form = ("ms", 1e3, ".3g") if max(map(abs, frames["delay_s"])) < 1 else ("s", 1.0, ".1f")
        least, median, most = (format(scale * delay, form) for delay in frames["delay_s"])
        line += f"; left images were logged {median} {unit} after their stamps ({least} to {most} {unit})"
    return line
