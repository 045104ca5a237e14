"""`roverflow score`: errors of a result log against ground truth."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from flow.cli.outputs import check_outputs, write_text
from flow.cli.report import say
from flow.errors import COMPLETE, INCOMPLETE, UsageError

HELP = "print the errors of a result log, or of the logs of a fleet, against ground truth"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("result", type=Path, metavar="OUT.mcap", help="result log, or the folder of a fleet")
    truth = "log with the /truth topics, a file or a folder; repeatable (the result itself)"
    sub.add_argument("--truth", type=Path, action="append", metavar="LOG", help=truth)
    sub.add_argument("--json", type=Path, metavar="FILE", help="write all figures as JSON")


def run(options: argparse.Namespace) -> int:
    """Print the score."""
    if options.result.is_dir():
        return _score_fleet(options)
    from recordings.scoring.score import score
    from recordings.scoring.table import format_score

    truth = options.truth or [options.result]
    check_outputs({"score": options.json}, [options.result, *truth])
    result = score(options.result, truth)
    write_text(options.json, result.to_json())
    say(format_score(result))
    return INCOMPLETE if result.lost or result.unscored or result.other_input else COMPLETE


def _score_fleet(options: argparse.Namespace) -> int:
    """Print a table for each pipeline of a fleet."""
    from flow.cli.fleet.catalogue import as_table
    from flow.cli.fleet.page import score_logs, score_rows
    from recordings.scoring.table import SCORES

    if options.truth:
        raise UsageError("--truth is for one result log; the truth of a fleet is that in its logs")
    check_outputs({"scores": options.json})
    scores, others, damaged = score_logs(options.result)
    figures = {name: {log: json.loads(found.to_json()) for log, found in logs.items()} for name, logs in scores.items()}
    write_text(options.json, json.dumps({"fleet": str(options.result), "pipelines": figures}, indent=2))
    for pipeline, logs in scores.items():
        say(f"{pipeline}\n{as_table([dict(zip(SCORES, row, strict=True)) for row in score_rows(logs)], SCORES)}")
    for name, why in others.items():
        say(f"not scored: {name}: {why}")
    unscored = any(found.unscored for logs in scores.values() for found in logs.values())
    return INCOMPLETE if damaged or unscored else COMPLETE
