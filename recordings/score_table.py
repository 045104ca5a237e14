"""The score of a run as a table for a terminal."""

from __future__ import annotations

import math
from textwrap import wrap
from typing import Any

from recordings.errors import counted
from recordings.pose_measures import format_pose
from recordings.scoring import Score
from recordings.stereo_measures import CROP_STEP, REGIONS, THRESHOLDS
from recordings.terrain_measures import format_terrain


def format_score(found: Score) -> str:
    """The score as a table for a terminal, at most 100 columns wide."""
    parts = [_frame_lines(found)]
    if found.disparity is not None:
        parts.append(_disparity_lines(found.disparity))
    if found.terrain is not None:
        parts.append(format_terrain(found.terrain))
    parts.append(_pose_lines(found))
    return "\n\n".join("\n".join(lines) for lines in parts if lines)


def format_brief(found: Score) -> str:
    """The main figures in a few lines for a terminal."""
    lines = _frame_lines(found)
    if found.disparity is not None:
        seen = found.disparity["whole_image"]["nonocc"]
        off = f"{_percent(seen['bad_1'])} off by over 1 px, or unknown"
        lines.append(f"disparity    of what both cameras see, {off}; RMS error {_number(seen['rmse'], 2)} px")
    if found.terrain is not None:
        rings, hazards, rocks = (found.terrain[name] for name in ("heights", "hazards", "rocks"))
        known = _percent(rings["0-8 m"]["completeness"])
        near, far = (_number(100 * rings[ring]["raw"]["rmse"], 1) for ring in ("0-4 m", "0-8 m"))
        recall, missed, alarms = (_percent(hazards[name]) for name in ("recall", "false_safe", "false_alarm"))
        in_view = (f"{rock['found']:.0f} of {rock['in_view']:.0f}" for rock in rocks.values())
        lines += [
            f"elevation    {known} of seen cells known; RMS error {near} cm to 4 m away, {far} cm to 8 m",
            f"hazards      {recall} of their cells found, {missed} called free; of free cells {alarms} called hazards",
            f"rocks        {' of 0.2 m and higher in view found, '.join(in_view)} of 0.3 m and higher",
        ]
    return "\n".join([*lines, *_pose_lines(found)])


def _frame_lines(found: Score) -> list[str]:
    lines = [f"frames       {found.compared} of {found.frames} have results"]
    if found.beyond:
        lines.append(f"not counted  {counted(found.beyond, 'frame')} outside the part of the log that was run")
    for topic, stamps in found.missing.items():
        lines.append(f"missing      {topic}: {len(stamps)} of {counted(found.frames, 'frame')}, scored as all unknown")
    for topic, count in found.unmatched.items():
        lines.append(f"unmatched    {topic}: {counted(count, 'message')} at stamps without truth, not scored")
    told = [
        f"not scored   {topic}: {counted(count, 'frame')}: {why}"
        for topic, reasons in found.unscored.items()
        for why, count in reasons.items()
    ]
    told += [
        f"lost         {counted(count, 'message')} of {log}: {why}"
        for log, reasons in found.lost.items()
        for why, count in reasons.items()
    ]
    for line in told:
        lines += wrap(line, 100, subsequent_indent=" " * 13, break_long_words=False, break_on_hyphens=False)
    return lines


def _disparity_lines(d: dict[str, Any]) -> list[str]:
    hidden, beyond = d["given_occluded"], d["given_without_truth"]
    occluded = f"{_percent(hidden['share']):>7} of all values, {_percent(hidden['bad_2'])} of these off by over 2 px"
    limits = "".join(f"{f'bad-{limit:g}':>8}" for limit in THRESHOLDS)
    return [
        "disparity    bad-T: share off by over T px, or unknown; mean and RMS error in px, of the known",
        f"               whole image       pixels    known |{limits} |    mean     RMS",
        *(_region_line(name, d["whole_image"][name]) for name in REGIONS),
        *(_known_line(name, d["whole_image"][name]) for name in ("nonocc", "all")),
        *_cropped_lines(d["cropped_image"]),
        "             values given where stereo cannot measure",
        f"               only one camera sees  {occluded}",
        f"               no true value         {_percent(beyond['share']):>7} of all values (sky, or not known)",
    ]


def _cropped_lines(cropped: dict[str, Any]) -> list[str]:
    crops = cropped["leftmost_columns_cropped"]
    if not any(crops):
        return []
    columns = f"{crops[0]}" if len(crops) == 1 else f"{crops[0]} to {crops[-1]}"
    title = f"               without the leftmost {columns} columns (the range of the truth, rounded up to {CROP_STEP})"
    return [title, *(_region_line(name, cropped[name]) for name in REGIONS)]


def _region_line(name: str, m: dict[str, float]) -> str:
    bad = "".join(f"{_percent(m[f'bad_{limit:g}']):>8}" for limit in THRESHOLDS)
    errors = "".join(f"{_number(m[key], 3):>8}" for key in ("mae", "rmse"))
    return f"               {name:<12} {m['pixels']:11.0f} {_percent(m['density']):>8} |{bad} |{errors}"


def _known_line(name: str, m: dict[str, float]) -> str:
    bad = "".join(f"{_percent(m[f'bad_{limit:g}_known']):>8}" for limit in THRESHOLDS)
    return f"               {f'{name}, of the known':<33} |{bad} |"


def _pose_lines(found: Score) -> list[str]:
    return [*_tilt_lines(found), *(format_pose(found.pose) if found.pose is not None else [])]


def _tilt_lines(found: Score) -> list[str]:
    lines = [f"tilt         not scored in {counted(count, 'frame')}: {why}" for why, count in found.untilted.items()]
    if (t := found.tilt) is not None:
        mean, worst = (math.degrees(t[name]) for name in ("mean", "max"))
        frames = counted(int(t["frames"]), "frame")
        lines = [f"tilt         mean error {mean:.3f} deg, largest {worst:.3f} deg, in {frames}", *lines]
    return lines


def _percent(value: float) -> str:
    return "-" if math.isnan(value) else f"{100 * value:.2f}%"


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{round(value, digits) + 0.0:.{digits}f}"  # never -0.00
