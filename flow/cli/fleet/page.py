"""A fleet's catalogue as one HTML page, and its scores as a table."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from flow.cli.fleet.catalogue import NAME, Catalogue
from flow.contracts import counted
from recordings.errors import LogError
from recordings.reporting.page import html_table, write_page
from recordings.scoring.score import score
from recordings.scoring.table import SCORES, brief_figures, brief_row

_COLUMNS = ("name", "verdict", "frames", "findings", "seconds", "why")


def write_fleet_page(path: Path, folder: Path) -> None:
    """Write the page of a fleet's folder: verdicts, times, losses and findings of every log."""
    rows = Catalogue(folder).rows(sort="state, verdict, name")
    ended = Counter(str(row["verdict"] if row["state"] == "done" else row["state"]) for row in rows)
    hours = sum(row["seconds"] or 0.0 for row in rows) / 3600
    gigabytes = sum(row["bytes"] or 0 for row in rows) / 1e9
    facts = [(name, str(number)) for name, number in ended.items()]
    facts += [("hours of runs", f"{hours:.2f}"), ("GB", f"{gigabytes:.2f}")]
    cells = [[_cell(row, column) for column in _COLUMNS] for row in rows]
    about = f"<p>{counted(len(rows), 'log')}</p>{html_table(facts)}"
    write_page(path, folder.resolve().name, [about, f"<h2>Logs</h2>{html_table(cells, _COLUMNS)}"])


def score_rows(folder: Path) -> dict[str, list[tuple[str, ...]]]:
    """Pipeline -> rows of `SCORES` of the logs that have truth, and their mean; the catalogue keeps the scores."""
    by_pipeline = dict[str, list[tuple[str, list[float]]]]()
    catalogue = Catalogue(folder, create=(folder / NAME).is_file())
    for row in catalogue.rows("state = 'done' AND result IS NOT NULL"):
        try:
            found = score(folder / row["result"], Path(row["log"]))
        except LogError:  # the log has no truth, or is gone
            continue
        figures = brief_figures(found)
        known = {name: value for name, value in zip(SCORES[1:], figures, strict=True) if not math.isnan(value)}
        catalogue.put(row["name"], {"scores": known})
        by_pipeline.setdefault(row["pipeline"], []).append((row["name"], figures))
    table = {}
    for pipeline, logs in by_pipeline.items():
        mean = [_mean([values[place] for _, values in logs]) for place in range(len(SCORES) - 1)]
        table[pipeline] = [brief_row(name, values) for name, values in [*logs, ("mean", mean)]]
    return table


def _cell(row: Mapping[str, Any], column: str) -> str:
    if column == "verdict":
        return str(row["verdict"] if row["state"] == "done" else row["state"])
    if column == "frames":
        return "" if row["frames"] is None else f"{row['complete']} of {row['frames']}"
    value = row[column]
    if column == "findings":
        return " ".join(f"{stream}: {sentence}" for stream, sentence in json.loads(value or "{}").items())
    return "" if value is None else f"{value:.1f}" if isinstance(value, float) else str(value)


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else math.nan
