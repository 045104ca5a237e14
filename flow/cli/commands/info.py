"""`roverflow info`: what a log contains, whether a pipeline would accept it, and what to type."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flow.cli.outputs import add_log, add_pipeline_options, check_outputs, write_text
from flow.cli.report import say
from flow.errors import COMPLETE, INCOMPLETE, UNUSABLE, UsageError
from flow.runtime.graph import Graph
from recordings.containers.finding import find_files

if TYPE_CHECKING:
    from recordings.inventory.poses import MaxGapOf

HELP = "show what a log contains, and what is missing"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    add_log(sub)
    add_pipeline_options(sub)
    sub.add_argument("--json", action="store_true", help="print JSON")
    written = "write the pipeline with the topics found; comments list what is missing"
    sub.add_argument("--write-pipeline", type=Path, metavar="FILE", help=written)


def run(options: argparse.Namespace) -> int:
    """Print the description of a log, and the command to run or the settings that it needs."""
    find_files(options.log)  # refuses a wrong name at once
    if options.write_pipeline is not None and options.write_pipeline.exists():
        raise UsageError(f"{options.write_pipeline} exists; choose another name or remove it")
    check_outputs({"pipeline": options.write_pipeline})
    from flow.cli.advice import pipeline_for, refusal_of
    from flow.cli.debugging.result_input import check_source
    from flow.config.loader import load
    from recordings.inventory.description import describe
    from recordings.inventory.text import format_description

    graph = load(options.pipeline, options.set)
    check_source(graph)
    with graph.source.open(options.log) as log:
        description = describe(log, *_tolerances(graph)) | {"refused": refusal_of(graph, log)}
        if options.write_pipeline is not None:
            write_text(options.write_pipeline, pipeline_for(options.pipeline, graph.source, log).rstrip("\n"))
    if options.json:
        say(json.dumps(description, indent=2))
    else:
        say(format_description(description))
        say("\n".join(_verdict(options, description, graph)))
        if options.write_pipeline is not None:
            say(f"wrote {options.write_pipeline}")
    if description["refused"] and not description["result"]:
        return UNUSABLE
    return INCOMPLETE if description["damage"] else COMPLETE


def _verdict(options: argparse.Namespace, description: dict[str, Any], graph: Graph) -> list[str]:
    """Whether a run would accept the log, and what to type."""
    from flow.cli.advice import advice, remedies

    name = f"run -p {options.pipeline}"
    if description["result"]:
        return [f"{name}: would refuse this log: it contains results; run the log that they were made from"]
    if description["refused"]:
        return [f"{name}: would refuse this log: {description['refused']}", *remedies(description)]
    if why := _caveat(graph, description["frames"]):
        return [f"{name}: can run on this log, but {why} (see frames)"]
    return [f"{name}: can run on this log", *advice(options, description, graph)]


def _caveat(graph: Graph, frames: dict[str, Any]) -> str:
    """Why a run would produce no frame although the log has all streams; empty if it would produce some."""
    if not frames["pairs"] and {"left", "right"} <= graph.source_streams:
        return "no left image has a right image near enough in time"
    return "no frame has tilt readings near enough in time" if frames["with_tilt"] == 0 else ""


def _tolerances(graph: Graph) -> tuple[int, MaxGapOf | None, MaxGapOf | None]:
    """The pipeline's slop between left and right, ns, and for tilts and poses the function from their intervals to the
    largest gap, ns (None: not interpolated)."""
    from flow.align import Interpolate, Pair

    slop: int = Pair.slop
    max_gaps: dict[str, MaxGapOf] = {}
    for node in graph.aligners:
        if isinstance(node.actor, Pair) and {*node.inputs.values()} == {"left", "right"}:
            slop = node.actor.slop
        if isinstance(node.actor, Interpolate):
            max_gaps[node.inputs["stream"]] = node.actor.max_gap_of
    return slop, max_gaps.get("inclinometer"), max_gaps.get("odometry")
