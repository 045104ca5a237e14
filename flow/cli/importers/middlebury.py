"""`roverflow import middlebury`: makes a log from a Middlebury stereo scene."""

from __future__ import annotations

import argparse
from pathlib import Path

from flow.cli.outputs import check_outputs
from flow.cli.report import say
from flow.errors import COMPLETE

HELP = "a Middlebury scene with ground truth (assumes a level camera 1 m above ground)"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("source", type=Path, metavar="SOURCE", help="folder of a scene")
    sub.add_argument("out", type=Path, metavar="OUT.mcap", help="log to write")


def run(options: argparse.Namespace) -> int:
    """Write the log."""
    from recordings.importers.middlebury import import_scene

    inputs = [*options.source.iterdir()] if options.source.is_dir() else []
    check_outputs({"input log": options.out}, inputs)
    say(f"{options.out}: {import_scene(options.source, options.out)}")
    return COMPLETE
