"""`roverflow graph`: draws the dataflow of a pipeline."""

from __future__ import annotations

import argparse

from flow.cli.outputs import add_pipeline_options
from flow.cli.report import say
from flow.errors import COMPLETE

HELP = "draw the dataflow of a pipeline"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    add_pipeline_options(sub)
    sub.add_argument("--format", choices=("text", "mermaid", "svg"), default="text")
    sub.add_argument("--expand", action="store_true", help="draw the streams inside templates one by one")


def run(options: argparse.Namespace) -> int:
    """Print the drawing."""
    from flow.config.draw import draw
    from flow.config.loader import load

    say(draw(load(options.pipeline, options.set), options.format, options.expand))
    return COMPLETE
