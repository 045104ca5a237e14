"""`roverflow report`: one HTML page about a run."""

from __future__ import annotations

import argparse
from pathlib import Path

from flow.cli.outputs import check_outputs
from flow.cli.report import say
from flow.errors import COMPLETE, INCOMPLETE, UsageError

HELP = "write one HTML page about a result log, about two side by side, or about a fleet"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument(
        "results", nargs="+", type=Path, metavar="OUT.mcap", help="one or two result logs, or the folder of a fleet"
    )
    sub.add_argument("-o", "--out", type=Path, metavar="OUT.html", help="the HTML page (OUT.html beside the first log)")


def run(options: argparse.Namespace) -> int:
    """Write the page."""
    first = options.results[0]
    if len(options.results) > (1 if any(result.is_dir() for result in options.results) else 2):
        raise UsageError("give one or two result logs, or the folder of one fleet")
    out = options.out or (first / "report.html" if first.is_dir() else first.with_suffix(".html"))
    check_outputs({"report": out}, options.results)
    if first.is_dir():
        from flow.cli.fleet.page import write_fleet_page

        write_fleet_page(out, first)
        say(f"wrote {out}")
        return COMPLETE
    from recordings.reporting.page import write_report

    unreadable = write_report(out, options.results)
    say(f"wrote {out} ({out.stat().st_size / 1e6:.1f} MB)")
    for why in unreadable:
        say(f"WARNING: {why}; the page shows the rest")
    return INCOMPLETE if unreadable else COMPLETE
