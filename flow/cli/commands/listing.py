"""`roverflow list`: what the catalogue of a fleet contains."""

from __future__ import annotations

import argparse
import csv
import io
import json
from pathlib import Path

from flow.cli.report import say
from flow.errors import COMPLETE

HELP = "list the logs of a fleet: verdict, losses, times"
SHOWN = ("name", "state", "verdict", "complete", "frames", "seconds", "pipeline", "node", "why")


def add_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("folder", type=Path, metavar="DIR", help="folder of a fleet")
    where = "SQL condition on the catalogue's columns, such as \"verdict != 'COMPLETE'\""
    sub.add_argument("--where", default="", metavar="SQL", help=where)
    sub.add_argument(
        "--sort", default="name", metavar="COLUMNS", help="SQL columns to sort by, such as 'seconds DESC' (name)"
    )
    form = sub.add_mutually_exclusive_group()
    form.add_argument("--json", action="store_true", help="print all columns as JSON")
    form.add_argument("--csv", action="store_true", help="print all columns as CSV")


def run(options: argparse.Namespace) -> int:
    """Print the rows."""
    from flow.cli.fleet.catalogue import COLUMNS, Catalogue, as_table

    rows = Catalogue(options.folder).rows(options.where, options.sort)
    if options.json:
        for row in rows:
            row |= {name: json.loads(row[name]) for name in ("losses", "findings", "scores") if row[name]}
        say(json.dumps(rows, indent=2))
    elif options.csv:
        text = io.StringIO()
        writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        say(text.getvalue().rstrip("\n"))
    else:
        say(as_table(rows, SHOWN))
    return COMPLETE
