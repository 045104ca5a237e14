"""One self-contained HTML page about a result log, or about two beside each other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path

import numpy as np

from flow.contracts import counted
from recordings.atomic_write import written
from recordings.comparison.diff import diff
from recordings.comparison.text import format_diff, moment
from recordings.errors import LogError
from recordings.export.map_files import MapFiles
from recordings.export.page_layout import Page
from recordings.export.png_pages import PAGES, elevation_page, navigation_page
from recordings.reporting.figures import MAX_WIDTH, line_plot, picture, track_plot
from recordings.reporting.run_facts import RunFacts, read_facts
from recordings.sinks.overwrite import REPORT
from stages.data import ElevationMap, NavigationMap

MAX_LOSSES = 100  # rows of the table
MAX_REGIONS = 6  # frames of reference whose maps are drawn
STYLE = Path(__file__).with_name("style.css")


def write_report(path: Path, results: Sequence[Path]) -> list[str]:
    """Write the page of one result log, or of two beside each other; returns what of them cannot be read.

    Raises LogError if a file is not a result log or cannot be read, and UnwritableError if the page cannot be written.
    """
    facts = [read_facts(results[0])]
    facts += [read_facts(result, facts[0].drawn) for result in results[1:]]
    names = _names([found.path for found in facts])
    parts = [
        _beside([_verdict(found) for found in facts]),
        _section("What differs", _differences(results)),
        _section("Map", _beside([_regional(found) for found in facts])),
        _section("Plots", _plots(facts, names)),
        *(_section(name.capitalize(), _beside([_frame(found, name) for found in facts])) for name in facts[0].drawn),
        _section("Losses", _beside([_losses(found) for found in facts])),
        _section("Parameters", _beside([_parameters(found) for found in facts])),
    ]
    write_page(path, " and ".join(names), parts)
    return [f"{found.path}: {why}" for found in facts for why in found.unreadable]


def _names(results: Sequence[Path]) -> list[str]:
    """The names of the files, with their folders where two are alike."""
    names = [result.name for result in results]
    return names if len(set(names)) == len(names) else [str(result) for result in results]


def write_page(path: Path, title: str, parts: Sequence[str]) -> None:
    """Write a page with a title and these parts, HTML."""
    head = [
        f"<!doctype html>\n{REPORT}\n<html lang=en><head><meta charset=utf-8>",
        '<meta name=viewport content="width=device-width, initial-scale=1">',
        f"<title>{escape(title)}</title><style>{STYLE.read_text('utf-8')}</style></head><body><h1>{escape(title)}</h1>",
    ]
    with written(path) as temporary:
        temporary.write_text("\n".join([*head, *parts, "</body></html>"]), encoding="utf-8", errors="backslashreplace")


def _section(title: str, content: str) -> str:
    return f"<h2>{escape(title)}</h2>{content}" if content else ""


def _beside(parts: Sequence[str]) -> str:
    return f"<div class=runs>{''.join(f'<div>{part}</div>' for part in parts)}</div>" if any(parts) else ""


def _differences(results: Sequence[Path]) -> str:
    return f"<pre>{escape(format_diff(diff(results[0], results[1])))}</pre>" if len(results) == 2 else ""


def html_table(rows: Sequence[Sequence[str]], head: Sequence[str] = ()) -> str:
    """Rows of texts as an HTML table."""
    first = f"<tr>{''.join(f'<th>{escape(cell)}</th>' for cell in head)}</tr>" if head else ""
    body = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    return f"<table>{first}{body}</table>"


def _verdict(facts: RunFacts) -> str:
    """Verdict, counts and findings."""
    verdict = facts.counts.get("verdict", "the log is truncated before its verdict")
    drops = {name.removeprefix("drops."): value for name, value in facts.counts.items() if name.startswith("drops.")}
    findings = [(name.removeprefix("findings."), value) for name, value in facts.counts.items() if "findings." in name]
    none = "none" if facts.counts else "unknown"
    rows = [
        ("log", facts.about.get("log", "")),
        ("pipeline", facts.counts.get("pipeline", "")),
        ("frames", f"{facts.counts.get('frames_out', '?')} of {facts.counts.get('frames_in', '?')} complete"),
        ("losses", ", ".join(f"{number} {reason}" for reason, number in drops.items()) or none),
        *findings,
        *(("unreadable", reason) for reason in facts.unreadable),
        ("version", facts.about.get("roverflow", "")),
    ]
    return f'<p class="verdict {escape(verdict)}">{escape(verdict)}</p>{html_table(rows)}'


def _regional(facts: RunFacts) -> str:
    """The regional maps of the whole run: of the largest frames of reference, as visual odometry may begin new ones."""
    notes, drawn = [], list[tuple[int, MapFiles]]()
    for maps in facts.regional.values():
        try:
            if maps.close() and maps.bounds is not None:
                drawn.append((math.prod(maps.bounds.shape), maps))
        except LogError as error:
            notes.append(f"<p>{escape(str(error))}</p>")
    drawn.sort(key=lambda found: -found[0])
    if (more := len(drawn) - MAX_REGIONS) > 0:
        notes.append(f"<p>{counted(more, 'smaller map')} in other frames of reference or parts.</p>")
    pages = [page for _, maps in drawn[:MAX_REGIONS] for page in _region_pages(maps)]
    pictures = [picture(page, f"regional {name} map") for name, page in pages]
    return "".join([f"<div class=pictures>{''.join(pictures)}</div>" if pictures else "", *notes])


def _region_pages(maps: MapFiles) -> Iterator[tuple[str, Page]]:
    """Name and page of the elevation map and the navigation map."""
    if (terrain := maps.elevation) is not None:
        heights, size = terrain.overview("elevation", MAX_WIDTH)
        grid = ElevationMap(maps.stamp, {"elevation": heights}, size, terrain.origin, terrain.frame_id)
        yield "elevation", elevation_page(grid)
    if (navigation := maps.navigation) is not None:
        cells, size = navigation.overview("cells", MAX_WIDTH)
        reason = np.zeros(cells.shape, np.uint8)
        verdicts = NavigationMap(maps.stamp, cells, reason, size, navigation.origin, navigation.frame_id)
        yield "navigation", navigation_page(verdicts)


def _plots(facts: Sequence[RunFacts], names: Sequence[str]) -> str:
    """Shares of pixels and cells over time, and the way driven."""
    begin = min((found.stamps[0] for found in facts if found.stamps), default=0)
    plots = []
    for name in dict.fromkeys(name for found in facts for name in found.series):
        series = [found.series.get(name, {}) for found in facts]
        curves = {
            label: [((stamp - begin) / 1e9, value) for stamp, value in sorted(values.items())]
            for label, values in zip(names, series, strict=True)
        }
        plots.append(line_plot(name, curves))
    for frame_id in dict.fromkeys(frame_id for found in facts for frame_id in found.tracks):
        tracks = {name: found.tracks.get(frame_id, []) for name, found in zip(names, facts, strict=True)}
        plots.append(track_plot(f"trajectory in {frame_id}, x right, y up, m", tracks))
    return f"<div class=pictures>{''.join(plots)}</div>"


def _frame(facts: RunFacts, name: str) -> str:
    """The pages of one frame."""
    if name not in facts.drawn:
        return ""
    stamp, messages = facts.drawn[name]
    pictures = [picture(PAGES[topic][1](message), f"{topic} of the {name}") for topic, message in messages.items()]
    return f"<p>at {moment(stamp)}</p><div class=pictures>{''.join(pictures)}</div>"


def _losses(facts: RunFacts) -> str:
    if not facts.losses:
        return f"<p>{'No loss is recorded before the log ends' if facts.unreadable else 'Nothing was lost'}.</p>"
    left_out = len(facts.losses) - MAX_LOSSES
    more = f"<p>{counted(left_out, 'more loss', 'more losses')} in /nav/diagnostics.</p>" if left_out > 0 else ""
    rows = [(stream, moment(int(stamp)), *why) for stream, stamp, *why in facts.losses[:MAX_LOSSES]]
    return html_table(rows, ("stream", "stamp", "reason", "detail")) + more


def _parameters(facts: RunFacts) -> str:
    changes = facts.about.get("overrides", "")
    shown = f"<p>Changes:</p><pre>{escape(changes)}</pre>" if changes else "<p>No changes to the pipeline.</p>"
    pipeline = escape(facts.about.get("pipeline", ""))
    return f"{shown}<details><summary>Pipeline, and its templates as comments</summary><pre>{pipeline}</pre></details>"
