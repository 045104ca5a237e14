"""`roverflow pipeline`: prints a pipeline file to start from."""

from __future__ import annotations

import argparse

from flow.cli.report import say
from flow.errors import COMPLETE

HELP = "print the YAML of a pipeline or of a template: roverflow pipeline rover > mine.yaml"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("name", metavar="NAME", help="a pipeline, a template such as rover_disparity, or a YAML file")


def run(options: argparse.Namespace) -> int:
    """Print the file."""
    from flow.config.loader import pipeline_file, pipeline_text

    say(pipeline_text(pipeline_file(options.name, templates=True)).rstrip("\n"))
    return COMPLETE
