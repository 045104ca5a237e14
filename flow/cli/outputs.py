"""What commands share: the log, checks of output paths, text outputs, and the options of a pipeline."""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from flow.errors import UsageError
from flow.runtime.graph import Graph
from recordings.atomic_write import check_writable, written
from recordings.containers.finding import RESULT_ENDING
from recordings.sinks.overwrite import is_ours

_ENDINGS = {  # of the names of outputs
    "log": ".mcap", "recording": ".rrd", "difference": ".rrd", "report": ".html", "picture": ".png"
}  # fmt: skip


def add_pipeline_options(sub: argparse.ArgumentParser) -> None:
    """Add -p and --set."""
    sub.add_argument("-p", "--pipeline", default="rover", help="rover, fast, accurate, paper, or a YAML file (rover)")
    sub.add_argument(
        "--set", action="append", default=[], metavar="STREAM.PARAM=VALUE", help="change a parameter (repeatable)"
    )


def add_log(sub: argparse.ArgumentParser) -> None:
    """Add the log: files or a folder."""
    sub.add_argument(
        "log", nargs="+", type=Path, metavar="LOG", help="a .mcap, .db3 or .bag file, several of them, or their folder"
    )


def default_result(logs: Sequence[Path]) -> Path:
    """The result log beside the first log."""
    log = logs[0].absolute() if logs[0].is_dir() else logs[0]
    return log.parent / f"{log.name if log.is_dir() else log.stem}{RESULT_ENDING}.mcap"


def write_text(path: Path | None, text: str) -> None:
    """Write a text output, if it has a path."""
    if path is None:
        return
    with written(path) as temporary:
        temporary.write_text(f"{text}\n", encoding="utf-8")


def check_outputs(outputs: Mapping[str, Path | None], inputs: Sequence[Path] = ()) -> None:
    """Refuse outputs that cannot be written, or that would replace an input, a foreign file or each other.

    outputs: kind -> path. A kind is one of those that `recordings.sinks.overwrite.is_ours` recognises.
    """
    taken: list[str] = []
    for kind, path in outputs.items():
        if path is None:
            continue
        if not path.parent.is_dir():
            raise UsageError(f"there is no folder {path.parent} for {path.name}; create it first")
        if path.exists() and not path.is_file():
            raise UsageError(f"{path} is a folder or a device; give the name of a file")
        for given in inputs:
            if path.exists() and given.exists() and path.samefile(given):
                raise UsageError(f"{path} is an input of this command; choose another name for the output")
        if (resolved := os.path.realpath(path)) in taken:
            raise UsageError(f"{path} is given for two outputs; choose another name for one")
        if path.exists() and not is_ours(path, kind):
            raise UsageError(f"{path} exists and is not a roverflow {kind}; choose another name or remove it")
        noun = "log" if kind.endswith("log") else kind
        if path.suffix.lower() != (ending := _ENDINGS.get(noun, path.suffix.lower())):
            raise UsageError(f"{path} is not the name of a {noun}; end it in {ending}")
        check_writable(path)
        taken.append(resolved)


def check_used(graph: Graph, given: Mapping[str, Sequence[str]]) -> None:
    """Refuse options of an output that no sink of the pipeline writes. given: ending of the output -> its options."""
    endings = {sink.suffix for _, sink in graph.sinks}
    for ending, options in given.items():
        if options and endings <= given.keys() - {ending}:
            raise UsageError(f"the pipeline has no sink that writes {ending} files; leave out {' and '.join(options)}")
