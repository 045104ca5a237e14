"""`roverflow stages`: what a pipeline can use, and the parameters of each."""

from __future__ import annotations

import argparse
import sys
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

from flow.cli.report import say
from flow.errors import COMPLETE

if TYPE_CHECKING:
    from flow.config.reference import NodeReference

HELP = "list stages, aligners, source and sinks; with a name, its inputs and parameters, or the fields of a data type"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("name", nargs="?", metavar="NAME", help="stage or data type, such as Match or Disparity")


def run(options: argparse.Namespace) -> int:
    """Print the list, or the parameters of one stage."""
    from flow.config.reference import stage_reference

    sys.path.append(str(Path.cwd()))  # so that stages can be in this folder
    found = stage_reference(options.name)
    say("\n".join(map(details, found)) if options.name else overview(found))
    return COMPLETE


def overview(nodes: list[NodeReference]) -> str:
    """One line for each class, by its role."""
    width = max(len(node.use) for node in nodes)
    lines = []
    for role in ("source", "aligner", "stage", "sink"):
        lines.append(f"{role}s:" if role != "source" else "source:")
        for node in (node for node in nodes if node.role == role):
            lines.append(f"  {node.use:{width}}  {textwrap.shorten(node.summary, 96, placeholder=' ...')}")
    return "\n".join(lines)


def details(node: NodeReference) -> str:
    """Inputs, output and parameters of one class; the fields of a data type."""
    optional = dict.fromkeys(node.optional_inputs, " (optional)")
    ports = [f"  {port}: {kind}{optional.get(port, '')}" for port, kind in node.inputs.items()]
    lines = [f"{node.use} ({node.role}): {node.summary}"]
    if node.role in ("data type", "codes"):
        return "\n".join([*lines, *(["fields:"] if node.role == "data type" else []), *ports])
    lines += ["inputs:", *ports] if ports else []
    lines += [f"output: {node.output}"] if node.output else []
    lines += ["parameters:"] if node.parameters else ["no parameters"]
    for item in node.parameters:
        unit = item.unit if item.default == "0" else ""  # other defaults have it
        known = ", ".join(filter(None, [item.type, unit, item.range]))
        lines.append(f"  {item.name} = {item.default}  ({known})")
        lines += textwrap.wrap(item.meaning, 100, initial_indent=" " * 6, subsequent_indent=" " * 6)
    return "\n".join(lines)
