"""An instant of a log through variants of a pipeline: what `roverflow try` runs and what it prints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from flow.cli.replay import one_thread_per_call, product_version
from flow.config.loader import load
from flow.contracts import counted
from flow.errors import UsageError
from flow.runtime.graph import Graph
from flow.runtime.run import fitted, run
from flow.runtime.variants import Variants, VariantSink, merged, sink_of

if TYPE_CHECKING:
    from recordings.source.log import McapLog

MAX_VARIANTS = 26  # one letter each


@dataclass(frozen=True)
class Part:
    """The frames of an instant. start, end: the part to read; at: the first frame of the instant; all in s after the
    log's first message. before: number of frames before it."""

    start: float
    end: float
    at: float
    before: int


def changes_of(given: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Variant -> its changes. A is the pipeline as it is; a setting with several values makes a variant of each.

    Examples
    --------
    >>> changes_of(["disparities=64", "points.camera_height=1 m", "disparities=96"])
    {'A': (), 'B': ('points.camera_height=1 m', 'disparities=64'), 'C': ('points.camera_height=1 m', 'disparities=96')}
    """
    by_name = dict[str, list[str]]()
    for change in given:
        by_name.setdefault(change.partition("=")[0].strip(), []).append(change)
    swept = [values for values in by_name.values() if len(values) > 1]
    if not given or len(swept) > 1:
        raise UsageError("give changes with --set; only one setting may have several values" if swept else "give --set")
    fixed = tuple(values[0] for values in by_name.values() if len(values) == 1)
    variants = [(*fixed, value) for value in swept[0]] if swept else [fixed]
    if len(variants) >= MAX_VARIANTS:
        raise UsageError(f"give at most {MAX_VARIANTS - 1} values of a setting, not {len(variants)}")
    return {"A": (), **{chr(ord("B") + number): changes for number, changes in enumerate(variants)}}


def part_of(log: McapLog, at: float, frames: int, before: int) -> Part:
    """The left images nearest to `at` (s after the log's first message), and those before them; raises UsageError."""
    times = log.file.times(log.channels("left")) if "left" in log.topics else np.zeros(0, np.int64)
    if not times.size:
        raise UsageError(f"{log.path} has no left images")
    first, last = ((int(time) - log.begin) / 1e9 for time in (times[0], times[-1]))
    if not first - 1 <= at <= last + 1:
        raise UsageError(f"--at {at:g} is outside the images of the log, which lie from {first:.3f} to {last:.3f} s")
    chosen = int(np.argmin(np.abs(times - log.begin - round(at * 1e9))))
    low, high = max(0, chosen - before), min(times.size, chosen + frames) - 1
    edges = np.concatenate([times[:1] - 1_000_000_000, (times[1:] + times[:-1]) // 2, times[-1:] + 1_000_000_000])
    start, end = (max(0, int(edges[place]) - log.begin) / 1e9 for place in (low, high + 1))
    return Part(start, end, (int(times[chosen]) - log.begin) / 1e9, chosen - low)


def hastened(graph: Graph) -> Graph:
    """A graph for a run of few frames: its stages use two cores for one frame, which never changes a result."""
    threads = {"threads": 2}
    nodes = (replace(n, actor=replace(n.actor, **threads)) if hasattr(n.actor, "threads") else n for n in graph.nodes)
    return replace(graph, nodes=tuple(nodes))


def run_variants(
    logs: Sequence[Path], pipeline: str, changes: Mapping[str, Sequence[str]], part: Part, folder: Path, workers: int
) -> tuple[dict[str, Path], Variants]:
    """Run all variants over a part of a log; returns their result logs in `folder`, and the graphs.

    Raises
    ------
    UsageError
        If a run would refuse the log, or the variants cannot be joined.
    """
    from stages.kernel_loading import loading_kernels

    graphs = {label: hastened(load(pipeline, overrides)) for label, overrides in changes.items()}
    with loading_kernels(), graphs["A"].source.open(logs, start=part.start, end=part.end) as log, one_thread_per_call():
        graphs = {label: fitted(graph, log) for label, graph in graphs.items()}
        variants = merged(graphs)
        about = {
            "roverflow": product_version(), "log": ", ".join(path.name for path in logs),
            "start": repr(part.start), "end": repr(part.end), "every": "",
        }  # fmt: skip
        sinks = tuple((label, _sink(graphs[label], variants, label, changes[label])) for label in graphs)
        paths = {label: folder / f"{label}.mcap" for label in graphs}
        run(replace(variants.graph, sinks=sinks), log, paths, workers=workers, about=about)
    missing = [label for label, path in paths.items() if not path.exists()]
    if missing:
        raise UsageError(
            f"no frame went through at {part.start:.3f} s; roverflow run --start {part.start:.3f} says why"
        )
    return paths, variants


def summary_lines(variants: Variants, part: Part, frames: int) -> list[str]:
    """What ran, for a terminal."""
    again = [name for label, own in variants.own.items() if label != "A" for name in own]
    before = f", after {counted(part.before, 'frame')} before it" if part.before else ""
    total = counted(len(variants.graph.stages), "stage")
    return [
        f"{counted(frames, 'frame')} from {part.at:.3f} s on{before}: {total}, {len(again)} of them for changes",
        f"the change touches {', '.join(dict.fromkeys(again)) or 'no stage'}",
    ]


def _sink(graph: Graph, variants: Variants, label: str, changes: Sequence[str]) -> Any:
    """The result log of a variant."""
    own = {merged_name: name for name, merged_name in variants.names[label].items()}
    about = {"pipeline": graph.text, "overrides": "\n".join(changes)}
    return VariantSink(sink_of(graph, ".mcap"), own, about)
