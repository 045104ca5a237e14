"""`roverflow report`: one HTML page about a run."""

from __future__ import annotations

import argparse
from pathlib import Path

from flow.cli.outputs import check_outputs
from flow.cli.report import say
from flow.errors import COMPLETE, UsageError

HELP = "write one HTML page about a result log, or about two beside each other"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("results", nargs="+", type=Path, metavar="OUT.mcap", help="one or two result logs")
    sub.add_argument("-o", "--out", type=Path, metavar="OUT.html", help="the page (OUT.html beside the first log)")


def run(options: argparse.Namespace) -> int:
    """Write the page."""
    if len(options.results) > 2:
        raise UsageError(f"give one or two result logs, not {len(options.results)}")
    out = options.out or options.results[0].with_suffix(".html")
    check_outputs({"report": out}, options.results)
    from recordings.reporting.page import write_report

    write_report(out, options.results)
    say(f"wrote {out} ({out.stat().st_size / 1e6:.1f} MB)")
    return COMPLETE
