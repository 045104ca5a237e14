"""`roverflow score`: errors of a result log against ground truth."""

from __future__ import annotations

import argparse
from pathlib import Path

from flow.cli.outputs import check_outputs, write_text
from flow.cli.report import say
from flow.errors import COMPLETE, INCOMPLETE

HELP = "errors of a result log, or of the logs of a fleet, against ground truth"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("result", type=Path, metavar="OUT.mcap", help="result log, or the folder of a fleet")
    sub.add_argument("--truth", type=Path, metavar="LOG.mcap", help="log with the /truth topics (the result itself)")
    sub.add_argument("--json", type=Path, metavar="FILE", help="write every figure as JSON")


def run(options: argparse.Namespace) -> int:
    """Print the score."""
    if options.result.is_dir():
        return _score_fleet(options.result)
    from recordings.scoring.score import score
    from recordings.scoring.table import format_score

    truth = options.truth or options.result
    check_outputs({"score": options.json}, [options.result, truth])
    result = score(options.result, truth)
    write_text(options.json, result.to_json())
    say(format_score(result))
    return INCOMPLETE if result.lost or result.unscored else COMPLETE


def _score_fleet(folder: Path) -> int:
    """Print a table for each pipeline of a fleet."""
    from flow.cli.fleet.catalogue import as_table
    from flow.cli.fleet.page import score_rows
    from recordings.scoring.table import SCORES

    tables = score_rows(folder)
    for pipeline, rows in tables.items():
        say(f"{pipeline}\n{as_table([dict(zip(SCORES, row, strict=True)) for row in rows], SCORES)}")
    if not tables:
        say("no log of the fleet has both a result and truth")
    return COMPLETE
