"""The score of a run as a table for a terminal."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from textwrap import wrap
from typing import Any

from flow.contracts import counted
from recordings.scoring.metrics import share
from recordings.scoring.score import Score
from recordings.scoring.stereo_metrics import CROP_STEP, REGIONS, THRESHOLDS

REGION_NAMES = {"nonocc": "seen by both", "all": "all", "occluded": "seen by one"}  # cameras
ROWS = (
    "height RMSE 0-8 m, with tilt and offset errors, cm",
    "levelled height RMSE, cm: 0-4 m; 4-8 m",
    "visible cells with a value; of these within 5 cm (levelled), %",
    "hallucinated values (no camera could see their cells), % of values",
    "values in cells without a pixel, %: all; not marked interpolated",
    "levelled errors within 1; 2 stated random sigmas (ideal 68; 95), %",
    "raw errors within 1; 2 stated total sigmas (ideal 68; 95), %",
    "detected rocks, at least half visible: 0.2 m; 0.3 m and higher",
    "detected rocks, also partly visible ones: 0.2 m; 0.3 m and higher",
    "free cells on a rock, % of free cells; rock cells called free, %",
    "false alarms, % of safe cells: all; worst slope bin below 15 deg",
    "hazard cells (rock or over 20 deg): detected; called free, %",
    "visible cells left unknown; free cells that no camera could see, %",
)
SCORES = ("log", "density", "bad-0.5", "bad-1", "RMS px", "height cm", "missed", "false alarm", "unknown")
_UNITS = {"RMS px": (1, "RMS (px)"), "height cm": (100, "height (cm)")}  # of `SCORES` other than %


def format_score(found: Score) -> str:
    """The score as a table for a terminal, at most 100 columns wide."""
    parts = [_frame_lines(found)]
    if found.disparity is not None:
        parts.append(_disparity_lines(found.disparity))
    if found.terrain is not None:
        parts.append(terrain_lines(found.terrain))
    parts.append(_motion_lines(found))
    return "\n\n".join("\n".join(lines) for lines in parts if lines)


def format_brief(found: Score) -> str:
    """The main metrics in a few lines for a terminal."""
    lines = _frame_lines(found)
    if found.disparity is not None:
        seen = found.disparity["whole_image"]["nonocc"]
        bad = f"{_percent(seen['bad_1'])} wrong by over 1 px or unknown"
        lines.append(f"disparity    {bad} where both cameras see; RMS error {_number(seen['rmse'], 2)} px")
    if found.terrain is not None:
        rings, hazards, rocks = (found.terrain[name] for name in ("heights", "hazards", "rocks"))
        known = _percent(rings["0-8 m"]["completeness"])
        near, far = (_number(100 * rings[ring]["raw"]["rmse"], 1) for ring in ("0-4 m", "0-8 m"))
        recall, missed, alarms = (_percent(hazards[name]) for name in ("recall", "false_safe", "false_alarm"))
        detected = [f"{rock['detected']:.0f} of {rock['visible']:.0f}" for rock in rocks.values()]
        lines += [
            f"elevation    {known} of visible cells known; RMS error {near} cm up to 4 m away, {far} cm up to 8 m",
            f"hazards      {recall} detected, {missed} called free; {alarms} of safe cells called hazards",
            f"rocks        {detected[0]} detected from a height of 0.2 m, {detected[1]} from 0.3 m",
        ]
    return "\n".join([*lines, *_motion_lines(found)])


def brief_figures(found: Score) -> list[float]:
    """The values of `SCORES` of a score; NaN where the truth does not have it."""
    whole = {} if found.disparity is None else found.disparity["whole_image"]
    seen: Mapping[str, float] = next((whole[kind] for kind in ("nonocc", "all") if whole and whole[kind]["pixels"]), {})
    ground = {} if found.terrain is None else found.terrain
    stereo = [seen.get(name, math.nan) for name in ("density", "bad_0.5", "bad_1", "rmse")]
    height = ground["heights"]["0-8 m"]["raw"]["rmse"] if ground else math.nan
    hazards = ground["hazards"] if ground else {}
    return [*stereo, height, *(hazards.get(name, math.nan) for name in ("false_safe", "false_alarm", "unknown"))]


def brief_row(name: str, values: Sequence[float]) -> tuple[str, ...]:
    """One row of `SCORES` as text; - is unknown."""
    density, half, one, rms, height, *cells = values
    shares = [_percent(value).replace("%", " %") for value in (density, half, one, *cells)]
    return (name, *shares[:3], _number(rms, 3), _number(100 * height, 2), *shares[3:])


def brief_columns(rows: Iterable[Sequence[float]]) -> dict[str, list[float]]:
    """Name with unit -> value of each row of `brief_figures`, in that unit."""
    columns = zip(SCORES[1:], zip(*rows, strict=True), strict=False)  # no column without rows
    scaled = ((*_UNITS.get(name, (100, f"{name} (%)")), column) for name, column in columns)
    return {title: [scale * value for value in column] for scale, title, column in scaled}


def _frame_lines(found: Score) -> list[str]:
    lines = [f"frames       {found.compared} of {found.frames} have results"]
    if found.beyond:
        lines.append(f"not counted  {counted(found.beyond, 'frame')} outside the part of the log that was run")
    notes = []
    if found.other_input:
        doubt = "the log with the truth has other bytes than the input of the run; it may be another traverse"
        notes.append(f"other input  {doubt}")
    for topic, stamps in found.missing.items():
        name, everywhere = topic.removeprefix("/nav/"), len(stamps) == found.frames
        remedy = f"; name the stream '{name}', and let McapSink write it" if everywhere else ""
        of_all = f"{len(stamps)} of {counted(found.frames, 'frame')}"
        notes.append(f"missing      {topic}: {of_all}, scored as all unknown{remedy}")
    for topic, count in found.unmatched.items():
        notes.append(f"unmatched    {topic}: {counted(count, 'message')} at stamps without truth, not scored")
    notes += [
        f"not scored   {topic}: {counted(count, 'frame')}: {why}"
        for topic, reasons in found.unscored.items()
        for why, count in reasons.items()
    ]
    notes += [
        f"lost         {counted(count, 'message')} of {log}: {why}"
        for log, reasons in found.lost.items()
        for why, count in reasons.items()
    ]
    for line in notes:
        lines += wrap(line, 100, subsequent_indent=" " * 13, break_long_words=False, break_on_hyphens=False)
    return lines


def _disparity_lines(d: dict[str, Any]) -> list[str]:
    hidden, beyond = d["given_occluded"], d["given_without_truth"]
    share_hidden, bad = _percent(hidden["share"]), _percent(hidden["bad_2"])
    limits = "".join(f"{f'bad-{limit:g}':>8}" for limit in THRESHOLDS)
    return [
        "disparity    bad-T: share wrong by over T px or unknown; MAE and RMS error of known pixels, px",
        f"               whole image       pixels    known |{limits} |     MAE     RMS",
        *(_region_line(name, d["whole_image"][name]) for name in REGIONS),
        *(_region_line(name, m) for name, m in d.get("by_surface", {}).items() if m["pixels"]),
        *(_known_line(name, d["whole_image"][name]) for name in ("nonocc", "all")),
        *_cropped_lines(d["cropped_image"]),
        "             estimates where stereo cannot measure",
        f"               seen by one camera    {share_hidden:>7} of all estimates, {bad} of these wrong by over 2 px",
        f"               no true value         {_percent(beyond['share']):>7} of all estimates (sky, or no truth)",
    ]


def _cropped_lines(cropped: dict[str, Any]) -> list[str]:
    crops = cropped["leftmost_columns_cropped"]
    if not any(crops):
        return []
    columns = f"{crops[0]}" if len(crops) == 1 else f"{crops[0]} to {crops[-1]}"
    reason = f"true disparity range rounded up to {CROP_STEP}"
    title = f"               without the leftmost {columns} columns ({reason})"
    return [title, *(_region_line(name, cropped[name]) for name in REGIONS)]


def _region_line(name: str, m: dict[str, float]) -> str:
    bad = "".join(f"{_percent(m[f'bad_{limit:g}']):>8}" for limit in THRESHOLDS)
    errors = "".join(f"{_number(m[key], 3):>8}" for key in ("mae", "rmse"))
    title = REGION_NAMES.get(name, f"both, {name}")
    return f"               {title:<12} {m['pixels']:11.0f} {_percent(m['density']):>8} |{bad} |{errors}"


def _known_line(name: str, m: dict[str, float]) -> str:
    bad = "".join(f"{_percent(m[f'bad_{limit:g}_known']):>8}" for limit in THRESHOLDS)
    return f"               {f'{REGION_NAMES[name]}, known pixels only':<33} |{bad} |"


def terrain_figures(found: dict[str, Any]) -> list[str]:
    """The values of `ROWS`."""
    heights, hazards, intervals, rocks = (found[name] for name in ("heights", "hazards", "intervals", "rocks"))
    near, far, all_ = (heights[ring] for ring in ("0-4 m", "4-8 m", "0-8 m"))
    worst = [value for name, value in hazards["by_slope"].items() if name != "15-20 deg" and not math.isnan(value)]
    return [
        _cm(all_["raw"]["rmse"]),
        f"{_cm(near['levelled']['rmse'])}; {_cm(far['levelled']['rmse'])}",
        _percents(all_["completeness"], all_["levelled"]["within_5cm"]),
        _percents(found["hallucinated"]["of_values"]),
        _percents(found["hallucinated"]["unseen"], found["hallucinated"]["claimed"]),
        _percents(*intervals["random"].values()),
        _percents(*intervals["total"].values()),
        "; ".join(f"{rock['detected']:.0f} of {rock['visible']:.0f}" for rock in rocks.values()),
        "; ".join(f"{rock['partly_visible_detected']:.0f} of {rock['partly_visible']:.0f}" for rock in rocks.values()),
        _percents(hazards["free_on_rock"], hazards["rock_false_safe"]),
        _percents(hazards["false_alarm"], max(worst, default=math.nan)),
        _percents(hazards["recall"], hazards["false_safe"]),
        _percents(hazards["unknown"], hazards["free_unseen"]),
    ]


def terrain_lines(found: dict[str, Any]) -> list[str]:
    """The metrics of a `TerrainTally` as lines."""
    lines = [
        "terrain      heights of cells that both cameras see, by distance from base_link; errors in cm",
        "               distance      cells    known |   RMSE    MAE   bias   NMAD  within 5 cm",
    ]
    levelled = ["               levelled: without the best-fit plane of each frame's errors (tilt and offset)"]
    for kind, title in (("raw", []), ("levelled", levelled)):
        lines += title
        for name, ring in found["heights"].items():
            h = ring[kind]
            errors = "".join(f"{_cm(h[key]):>7}" for key in ("rmse", "mae", "bias", "nmad"))
            known, close = _percent(share(h["cells"], ring["seen"])), _percent(h["within_5cm"])
            lines.append(f"               {name:<8} {ring['seen']:10d} {known:>8} |{errors} {close:>12}")
    slopes = found["hazards"]["by_slope"].items()
    return [
        *lines,
        *(f"             {label:66} {value:>17}" for label, value in zip(ROWS, terrain_figures(found), strict=True)),
        "             false alarms by slope: " + ", ".join(f"{name} {_percent(value)}" for name, value in slopes),
    ]


def _motion_lines(found: Score) -> list[str]:
    lines = [f"tilt         not scored in {counted(count, 'frame')}: {why}" for why, count in found.untilted.items()]
    if (t := found.tilt) is not None:
        mean, worst = (math.degrees(t[name]) for name in ("mean", "max"))
        frames = counted(int(t["frames"]), "frame")
        lines = [f"tilt         mean error {mean:.3f} deg, largest {worst:.3f} deg, in {frames}", *lines]
    return [*lines, *(pose_lines(found.pose) if found.pose is not None else [])]


def pose_lines(found: dict[str, float]) -> list[str]:
    """The metrics of a `PoseTally` as lines."""
    drift = "-" if math.isnan(found["drift"]) else f"{100 * found['drift']:.2f}%"
    parts = f"; {found['parts']} parts in frames of their own" if found["parts"] > 1 else ""
    error = f"{100 * found['max_error']:.1f} cm, {math.degrees(found['max_heading_error']):.2f} deg{parts}"
    lines = [f"pose         drift {drift} of {found['distance']:.2f} m driven; largest error {error}"]
    if found["missing"]:
        missing = counted(int(found["missing"]), "frame")
        lines.append(f"pose         not scored in {missing}: the result has no pose")
    return lines


def _percent(value: float) -> str:
    return "-" if math.isnan(value) else f"{100 * value:.2f}%"


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{round(value, digits) + 0.0:.{digits}f}"  # never -0.00


def _percents(*values: float) -> str:
    return "; ".join(_number(100 * value, 2) for value in values)


def _cm(value: float) -> str:
    return _number(100 * value, 2)
