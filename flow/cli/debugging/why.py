"""`roverflow why`: what made a cell of a navigation map."""

from __future__ import annotations

import argparse
import math
import re
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from flow.cli.arguments import AT, instant, pair
from flow.cli.debugging.viewer_cursor import without_cursor
from flow.cli.outputs import check_outputs
from flow.cli.report import say
from flow.contracts import counted
from flow.errors import COMPLETE, UsageError

if TYPE_CHECKING:
    from flow.cli.debugging.explanation import Explanation
    from flow.cli.debugging.regional_explanation import RegionalExplanation
    from stages.terrain.verdict_limits import Limit, Turn

HELP = "explain a cell of a navigation map: its pixels, its limits, and what would change its verdict"
MAX_TURNS = 5  # changes of parameters that are listed
MAX_COST = 255  # of a pixel that was not searched, or that nothing resembles


def add_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("result", type=Path, metavar="OUT.mcap", help="result log of a run")
    sub.add_argument("--at", type=instant, required=True, metavar="T", help=AT)
    sub._negative_number_matcher = re.compile(r"-\.?\d")  # a pair may begin with a minus
    place = sub.add_mutually_exclusive_group(required=True)
    place.add_argument("--cell", type=pair, metavar="X,Y", help="position of the cell in the map's frame, m")
    place.add_argument("--pixel", type=pair, metavar="U,V", help="column and row in the left rectified image")
    beside = "input of the run, one or more files (the log that the result names, beside it)"
    sub.add_argument("--log", nargs="+", type=Path, metavar="LOG", help=beside)
    stream = "stream of the navigation map (navigation_map)"
    sub.add_argument("--map", default="navigation_map", metavar="STREAM", help=stream)
    sub.add_argument("-o", "--out", type=Path, metavar="OUT.png", help="picture with the cell's pixels (OUT-why.png)")


def run(options: argparse.Namespace) -> int:
    """Print the explanation and draw the pixels."""
    out = options.out or options.result.with_name(f"{options.result.stem}-why.png")
    check_outputs({"picture": out}, [options.result])
    from flow.cli.debugging.explanation import why
    from flow.cli.debugging.result_input import note_damage
    from recordings.comparison.marked_pixels import write_marked

    options.at = without_cursor(options.at)
    note_damage(options.result)
    if _is_regional(options.result, options.map):
        return _regional(options)
    pixel = None if options.pixel is None else (round(options.pixel[0]), round(options.pixel[1]))
    found = why(options.result, options.at, cell=options.cell, pixel=pixel, log=options.log, stream=options.map)
    say("\n".join(lines_of(found)))
    if found.image.size:
        title = f"cell ({found.x:.3f}, {found.y:.3f}) m: {found.verdict.name.lower()}, {found.reason.name.lower()}"
        write_marked(out, found.image, found.pixels, title)
        say(f"wrote {out}")
    return COMPLETE


def _is_regional(result: Path, stream: str) -> bool:
    """Whether a stream of a result log is a navigation map in another frame than `level`."""
    from recordings.mcap.file import iter_decoded
    from stages.data import LEVEL_FRAME

    first = next(iter_decoded(result, [f"/nav/{stream}"], Counter()), None)
    return first is not None and hasattr(first[2], "info") and first[2].header.frame_id != LEVEL_FRAME


def _regional(options: argparse.Namespace) -> int:
    """Print the explanation of a cell of a regional map."""
    from flow.cli.debugging.regional_explanation import why_regional
    from recordings.comparison.text import moment

    if options.cell is None:
        raise UsageError(f"'{options.map}' is a regional map: give --cell in its frame")
    if options.out is not None:
        raise UsageError(f"'{options.map}' is a regional map, which has no picture of pixels; leave out --out")
    found = why_regional(options.result, options.at, options.cell, log=options.log, stream=options.map)
    verdict, reason = found.verdict.name.lower(), found.reason.name.lower()
    place = f"({found.x:.3f}, {found.y:.3f}) m in '{found.frame_id}'"
    head = f"cell {place}, map of {moment(found.stamp)}: {verdict}, reason {reason}"
    lines = [*found.notes, head, *_cell_lines(found)]
    conflicts = found.layers.get("contradictions", 0.0)
    more = f"; {conflicts:.0f} contradicted the height" if conflicts > 0 else ""
    thinned = f", thinned to {100 * found.spacing:g} cm" if found.spacing else ""
    kept = f"of the clouds that the log keeps{thinned}"
    lines.append(f"frames with measured points in the cell ({kept}): {len(found.frames)}{more}")
    lines += [
        f"  {moment(frame.stamp)}  {counted(frame.points, 'point'):>11}, height {frame.height:.3f} m"
        for frame in found.frames
    ]
    say("\n".join(lines))
    return COMPLETE


def lines_of(found: Explanation) -> list[str]:
    """The explanation for a terminal."""
    from recordings.comparison.text import moment

    verdict, reason = found.verdict.name.lower(), found.reason.name.lower()
    head = f"cell ({found.x:.3f}, {found.y:.3f}) m at {moment(found.stamp)}: {verdict}, reason {reason}"
    lines = [*found.notes, head]
    if found.recorded is not None and found.recorded != found.verdict:
        other = "from earlier frames, another version or another calibration"
        lines.append(f"the result has {found.recorded.name.lower()} here: {other}")
    return [*lines, *_cell_lines(found), *_pixel_lines(found), *_tilt_lines(found)]


def _cell_lines(found: Explanation | RegionalExplanation) -> list[str]:
    """Height, limits and turns."""
    layers, lines = found.layers, list[str]()
    if math.isfinite(layers.get("elevation", math.nan)):
        sigma = f" +- {math.sqrt(layers['variance']):.3f} m" if layers.get("variance", -1.0) >= 0 else ""
        points = f", {counted(round(layers['count']), 'point')}" if "count" in layers else ""
        lines.append(f"height: {layers['elevation']:.3f} m{sigma}{points}")
    if all(math.isnan(limit.value) for limit in found.limits.values()):
        lines.append("no height, so no limit applies")
    else:
        lines.append("limits:")
        lines += [f"  {name:<24} {_against(name, limit)}" for name, limit in found.limits.items()]
    lines += [f"not free because: {'; '.join(found.doubts)}"] if found.doubts else []
    turns = [f"would be {turn.verdict.name.lower()} with {_change(found.stream, turn)}" for turn in found.turns]
    return [*lines, *(turns[:MAX_TURNS] or ["no single parameter of the hazard rule changes the verdict"])]


def _pixel_lines(found: Explanation) -> list[str]:
    """The pixels and their disparities."""
    if not found.pixels.size:
        return ["pixels: no point of this frame lies in the cell"]
    width = found.image.shape[1] if found.image.size else 1
    rows, cols = divmod(found.pixels, width)
    sources = ", ".join(f"{number} {name.lower()}" for name, number in found.sources.items())
    sigmas = sorted(value for value in found.sigmas.tolist() if math.isfinite(value))  # only measured pixels have one
    sigma = f", sigma {sigmas[len(sigmas) // 2]:.2f} px" if sigmas else ""
    extent = f"columns {cols.min()} to {cols.max()}, rows {rows.min()} to {rows.max()}"
    low, high = found.disparities.min(), found.disparities.max()
    return [
        f"pixels: {found.pixels.size} in {extent}; {sources}",
        f"disparity: {low:.2f} to {high:.2f} px{sigma}; {found.distance:.2f} m from the camera",
        *_cost_lines(found),
    ]


def _cost_lines(found: Explanation) -> list[str]:
    """How bad the best matches are, and how ambiguous."""
    if not found.costs.size:
        return []
    lowest, next_lowest = found.costs[:, found.costs[0] < MAX_COST].astype(int)
    if not lowest.size:
        return [f"search: no cost below {MAX_COST}: not searched at full size, or no match was found"]
    cost, lead = (
        f"{values.min()} to {values.max()}, median {sorted(values)[len(values) // 2]}"
        for values in (lowest, next_lowest - lowest)
    )
    return [f"search: lowest cost {cost}; lead over the next {lead} (0 to {MAX_COST})"]


def _tilt_lines(found: Explanation) -> list[str]:
    if found.tilt is None:
        return []
    sigma = "" if found.tilt.sigma is None else f", sigma {math.degrees(found.tilt.sigma):.2f} deg"
    lean = math.degrees(math.acos(min(1.0, max(-1.0, float(found.tilt.up[2])))))
    return [f"tilt: up is {lean:.2f} deg off the z axis of '{found.tilt.frame_id}'{sigma}"]


def _against(name: str, found: Limit) -> str:
    value, limit, unit, made_of = found
    more = f" ({made_of})" if made_of else ""
    if math.isnan(value):
        return "none (only hidden cells have one)" if name == "drop" else f"unknown (limit {_shown(limit, unit)})"
    side = "above" if value > limit else "below"
    return f"{_shown(value, unit):>10}, {_shown(abs(value - limit), unit)} {side} the limit {_shown(limit, unit)}{more}"


def _change(stream: str, turn: Turn) -> str:
    """A change as --set takes it, with all digits of its number."""
    needed, unit = _in_words(turn.needed, turn.unit)
    return f"{stream}.{turn.parameter} = {f'{needed:.12g} {unit}'.strip()} (now {_shown(turn.now, turn.unit)})"


def _shown(value: float, unit: str) -> str:
    value, unit = _in_words(value, unit)
    return f"{value:.3g} {unit}".strip()


def _in_words(value: float, unit: str) -> tuple[float, str]:
    return (math.degrees(value), "deg") if unit == "rad" else (value, unit)
