"""An instant of a log through variants of a pipeline: what `roverflow try` runs and what it prints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from flow.cli.debugging.instants import Instant, Part, no_frame, part_of, run_from
from flow.cli.debugging.logged_state import resume
from flow.cli.debugging.result_input import check_source, graph_of, loss_at
from flow.cli.debugging.variants import Variants, VariantSink, merged, sink_of
from flow.cli.replay import ARROW_EXTRA, RESULT_TYPES, one_thread_per_call, product_version
from flow.config.loader import load
from flow.contracts import counted
from flow.errors import UsageError
from flow.runtime.graph import Graph
from flow.runtime.run import fitted, run
from recordings.scoring.result_log import names_of, stamps_of

MAX_VARIANTS = 26  # one letter each


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


def swept_setting(changes: Mapping[str, Sequence[str]]) -> tuple[str, list[str]] | None:
    """The name and the values of the setting that variants differ in; None for a single variant.

    Examples
    --------
    >>> swept_setting(changes_of(["points.camera_height=1 m", "points.camera_height=1.2 m"]))
    ('points.camera_height', ['1 m', '1.2 m'])
    """
    last = [own[-1].partition("=") for label, own in changes.items() if label != "A"]
    return (last[0][0].strip(), [value.strip() for _, _, value in last]) if len(last) > 1 else None


def run_variants(
    logs: Sequence[Path], pipeline: str | Path, changes: Mapping[str, Sequence[str]], folder: Path,
    *, at: Instant, frames: int, before: int, workers: int,
) -> tuple[dict[str, Path], Variants, Part, list[str]]:  # fmt: skip
    """Run all variants over a part of a log. Returns their result logs in `folder`, the merged graphs, the part that
    these logs cover, and notes for a terminal.

    pipeline: its name; or a result log of it, which then has the state before the instant; at, frames, before: as for
    `part_of`. The result logs have only the frames from the instant on. Raises UsageError if a run would refuse the
    log, or the variants cannot be joined.
    """
    from stages.kernel_loading import loading_kernels

    graphs = {
        label: load(pipeline, own) if isinstance(pipeline, str) else graph_of(pipeline, own, with_sinks=True)
        for label, own in changes.items()
    }
    check_source(graphs["A"])
    beside = loading_kernels(RESULT_TYPES, "recordings.comparison.recording", ARROW_EXTRA)
    with beside, graphs["A"].source.open(logs) as log, one_thread_per_call():
        graphs = {label: fitted(graph, log) for label, graph in graphs.items()}
        variants, states, notes = merged(graphs), dict[str, Any](), list[str]()
        part = part_of(log, at, frames, before)
        if isinstance(pipeline, Path):
            first, states, notes = resume(pipeline, graphs, variants, log=log, files=logs, before=part.stamp)
            part = part_of(log, at, frames, first)
        if part.frames < frames:
            notes.append(f"note: the log has only {counted(part.frames, 'frame')} from there on, not {frames}")
        log.narrow(part.start, part.end)
        about = {
            "roverflow": product_version(), "log": names_of(logs),
            "start": repr(part.first), "end": repr(part.end), "every": "",
        }  # fmt: skip
        sinks = tuple(
            (label, _sink(graphs[label], variants, label, changes[label], first=part.stamp)) for label in graphs
        )
        paths = {label: folder / f"{label}.mcap" for label in graphs}
        ran = replace(variants.graph, sinks=sinks)
        summary = run(ran, log, paths, workers=workers, about=about, states=states)
    through = stamps_of(paths["A"], results=True).size if all(path.exists() for path in paths.values()) else 0
    if not through:
        whole = pipeline if isinstance(pipeline, Path) else None
        raise no_frame(part, loss_at(part.stamp, summary["ledger"], whole), log, pipeline)
    for label, names in variants.names.items():
        lost = [one for one in summary["ledger"] if one["stage"] in names.values() and one["stamp"] >= part.stamp]
        if lost:
            frames_lost = counted(len({one["stamp"] for one in lost}), "frame")
            notes.append(f"note: {label} lost {frames_lost}, first in {lost[0]['stage']}: {lost[0]['detail']}")
    if through < part.frames:
        without = counted(part.frames - through, "frame")
        notes.append(f"note: {without} gave no result; {run_from(log, part, part.end, pipeline=pipeline)} says why")
    return paths, variants, replace(part, frames=through), notes


def summary_lines(variants: Variants, part: Part) -> list[str]:
    """What ran, for a terminal."""
    again = [name for label, own in variants.own.items() if label != "A" for name in own]
    once = len(variants.graph.stages) - len(again)
    change = counted(len(variants.own) - 1, "change") if len(variants.own) > 2 else "change"
    before = f", after {counted(part.before, 'frame')} before it" if part.before else ""
    ran = f"{counted(once, 'stage')} run once, {len(again)} again with the {change}"
    return [
        f"{counted(part.frames, 'frame')} from {part.at:.3f} s on{before}: {ran}",
        f"the change affects {', '.join(dict.fromkeys(again)) or 'no stage'}",
    ]


def _sink(graph: Graph, variants: Variants, label: str, changes: Sequence[str], *, first: int) -> Any:
    """The result log of a variant. first: the stamp, ns, of its first frame."""
    own = {merged_name: name for name, merged_name in variants.names[label].items()}
    about = {"pipeline": graph.text, "overrides": "\n".join(changes)}
    return VariantSink(sink_of(graph, ".mcap"), own, about, first)
