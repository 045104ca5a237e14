"""`roverflow score`: errors of a result log against ground truth."""

from __future__ import annotations

import argparse
from pathlib import Path

from flow.cli.outputs import check_outputs, write_text
from flow.cli.report import say
from flow.errors import COMPLETE, INCOMPLETE

HELP = "errors of a result log against ground truth"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("result", type=Path, metavar="OUT.mcap")
    sub.add_argument("--truth", type=Path, metavar="LOG.mcap", help="log with the /truth topics (the result itself)")
    sub.add_argument("--json", type=Path, metavar="FILE", help="write every figure as JSON")


def run(options: argparse.Namespace) -> int:
    """Print the score."""
    from recordings.scoring.score import score
    from recordings.scoring.table import format_score

    truth = options.truth or options.result
    check_outputs({"score": options.json}, [options.result, truth])
    result = score(options.result, truth)
    write_text(options.json, result.to_json())
    say(format_score(result))
    return INCOMPLETE if result.lost or result.unscored else COMPLETE
