"""A fleet's catalogue as one HTML page, and its scores as a table."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from flow.cli.fleet.catalogue import NAME, Catalogue, outcome, shown
from flow.contracts import counted
from recordings.errors import LogError
from recordings.reporting.page import html_table, write_page
from recordings.scoring.result_log import about_run
from recordings.scoring.score import Score, score
from recordings.scoring.table import SCORES, brief_figures, brief_row

_COLUMNS = ("name", "verdict", "frames", "findings", "seconds", "why")


def write_fleet_page(path: Path, folder: Path) -> None:
    """Write the page of a fleet's folder: verdicts, times, losses and findings of every log."""
    rows = Catalogue(folder).rows(sort="verdict = 'COMPLETE', state, name")
    ended = Counter(map(outcome, rows))
    hours = sum(row["seconds"] or 0.0 for row in rows) / 3600
    gigabytes = sum(row["bytes"] or 0 for row in rows) / 1e9
    facts = [(name, str(number)) for name, number in ended.items()]
    facts += [("hours of runs", f"{hours:.2f}"), ("GB", f"{gigabytes:.2f}")]
    cells = [[_cell(row, column) for column in _COLUMNS] for row in rows]
    about = f"<p>{counted(len(rows), 'log')}</p>{html_table(facts)}"
    write_page(path, folder.resolve().name, [about, f"<h2>Logs</h2>{html_table(cells, _COLUMNS)}"])


def score_logs(folder: Path) -> tuple[dict[str, dict[str, Score]], dict[str, str], set[str]]:
    """Pipeline -> log -> score; log -> why it has no score; and those of them whose result is gone or damaged, or
    whose log has changed.

    The catalogue keeps the scores.
    """
    scores, others, damaged = dict[str, dict[str, Score]](), dict[str, str](), set[str]()
    catalogue = Catalogue(folder, create=(folder / NAME).is_file())
    for row in catalogue.rows():
        try:
            if row["state"] != "done" or row["result"] is None:
                raise LogError("no result")
            if not about_run(folder / row["result"]):
                damaged.add(row["name"])
            found = score(folder / row["result"], Path(row["log"]))
            if found.lost:
                damaged.add(row["name"])
                raise LogError("; ".join(why for reasons in found.lost.values() for why in reasons))
            if found.other_input:
                damaged.add(row["name"])
                raise LogError("the log has changed since its run; run the fleet again")
        except LogError as error:  # the log has no truth, is gone or damaged
            others[row["name"]] = str(error)
            continue
        known = {name: value for name, value in zip(SCORES[1:], brief_figures(found), strict=True) if value == value}
        catalogue.put(row["name"], {"scores": known})
        scores.setdefault(row["pipeline"], {})[row["name"]] = found
    return scores, others, damaged


def score_rows(scores: Mapping[str, Score]) -> list[tuple[str, ...]]:
    """Rows of `SCORES` of logs, and of their mean."""
    figures = {name: brief_figures(found) for name, found in scores.items()}
    figures["mean"] = [_mean(values) for values in zip(*figures.values(), strict=True)]
    return [brief_row(name, values) for name, values in figures.items()]


def _cell(row: Mapping[str, Any], column: str) -> str:
    if column == "verdict":
        return outcome(row)
    if column == "frames":
        return "" if row["frames"] is None else f"{row['complete']} of {row['frames']}"
    value = row[column]
    if column == "findings":
        return " ".join(f"{stream}: {sentence}" for stream, sentence in json.loads(value or "{}").items())
    return shown(value)


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else math.nan
