"""`roverflow info`: what a log contains, and whether a pipeline would accept it."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from typing import Any

from flow.cli.outputs import add_log, add_pipeline_options
from flow.cli.report import say
from flow.errors import COMPLETE, INCOMPLETE, UsageError
from flow.runtime.graph import Graph
from recordings.containers.finding import find_files

HELP = "show what a log contains, and what is missing"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    add_log(sub)
    add_pipeline_options(sub)
    sub.add_argument("--json", action="store_true", help="print JSON")


def run(options: argparse.Namespace) -> int:
    """Print the description of a log."""
    find_files(options.log)  # refuses a wrong name at once
    from flow.config.loader import load
    from flow.runtime.run import fitted
    from recordings import McapSource
    from recordings.source.inventory import describe, format_description

    graph = load(options.pipeline, options.set)
    if not isinstance(graph.source, McapSource):
        raise UsageError(f"{graph.source_use} is not recordings.McapSource; info reads logs only through that source")
    with graph.source.open(options.log) as log:
        description = describe(log, *_tolerances(graph))
        try:
            fitted(graph, log)
            description["refused"] = ""
        except UsageError as error:
            description["refused"] = str(error)
    say(json.dumps(description, indent=2) if options.json else format_description(description))
    if not options.json:
        if why := description["refused"]:
            results = "it contains results; run the log that they were made from"
            answer = f"would refuse this log: {results if description['result'] else why}"
        else:
            answer = f"can run on this log{_caveat(graph, description['frames'])}"
        say(f"run -p {options.pipeline}: {answer}")
    return INCOMPLETE if description["damage"] else COMPLETE


def _caveat(graph: Graph, frames: dict[str, Any]) -> str:
    """Why a run would produce no frame although the log has all streams; empty if it would produce some."""
    if not frames["pairs"] and {"left", "right"} <= graph.source_streams:
        return ", but no left image has a right image near enough in time (see frames)"
    return ", but no frame has tilt readings near enough in time (see frames)" if frames["with_tilt"] == 0 else ""


def _tolerances(graph: Graph) -> tuple[int, Callable[[Sequence[int]], int] | None]:
    """The pipeline's slop between left and right, ns, and the function from the intervals of the tilt to its largest
    gap, ns (None: not interpolated)."""
    from flow.align import Interpolate, Pair

    slop: int = Pair.slop
    max_gap: Callable[[Sequence[int]], int] | None = None
    for node in graph.aligners:
        if isinstance(node.actor, Pair) and {*node.inputs.values()} == {"left", "right"}:
            slop = node.actor.slop
        if isinstance(node.actor, Interpolate) and node.inputs["stream"] == "inclinometer":
            max_gap = node.actor.max_gap_of
    return slop, max_gap
