"""An instant of a log through variants of a pipeline: what `roverflow try` runs and what it prints."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flow.cli.replay import one_thread_per_call, product_version
from flow.config.loader import load
from flow.contracts import counted
from flow.errors import UsageError
from flow.runtime.graph import Graph
from flow.runtime.run import fitted, run
from flow.runtime.variants import Variants, VariantSink, merged, sink_of
from recordings.containers.container import RawMessage

if TYPE_CHECKING:
    from recordings.source.log import McapLog

MAX_VARIANTS = 26  # one letter each
DAY = 86_400_000_000_000  # ns
MARGIN = 1_000_000_000  # ns before the first and after the last image of a log
Instant = float | np.datetime64 | np.timedelta64


@dataclass(frozen=True)
class Part:
    """The frames of an instant. start, end: the part to read; at: the first frame of the instant; all in s after the
    log's first message. before: number of frames before it; stamp: of its first frame, ns."""

    start: float
    end: float
    at: float
    before: int
    stamp: int


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


def swept_setting(changes: Mapping[str, Sequence[str]]) -> tuple[str, list[float]] | None:
    """The name, with its unit, and the numbers of the setting that variants differ in; None for other values.

    Examples
    --------
    >>> swept_setting(changes_of(["points.camera_height=1 m", "points.camera_height=1.2 m"]))
    ('points.camera_height (m)', [1.0, 1.2])
    """
    last = [own[-1].partition("=") for label, own in changes.items() if label != "A"]
    found = [re.fullmatch(r"\s*([-+.\deE]+?)\s*([a-zA-Z%].*)?", value) for _, _, value in last]
    units = {match[2] or "" for match in found if match}
    if len(last) < 2 or None in found or len(units) > 1:
        return None
    unit, name = units.pop(), last[0][0].strip()
    return f"{name} ({unit})" if unit else name, [float(match[1]) for match in found if match]


def part_of(log: McapLog, at: Instant, frames: int, before: int | np.datetime64) -> Part:
    """The left images nearest to an instant, and those before them; raises UsageError.

    at: s after the log's first message; or a stamp; or the time of the day, UTC, of one; before: their number, or the
    stamp of the first of them.
    """
    times = log.file.times(log.channels("left")) if "left" in log.topics else np.zeros(0, np.int64)
    if not times.size:
        raise UsageError(f"{log.path} has no left images")
    first, last = ((int(time) - log.begin) / 1e9 for time in (times[0], times[-1]))
    chosen = _nearest(log, times, at)
    if chosen is None:
        shown = f"{at:g}" if isinstance(at, float | int) else f"{np.datetime64(ns_of(at, log.begin), 'ns')}Z"
        raise UsageError(f"--at {shown} is outside the images of the log, which lie from {first:.3f} to {last:.3f} s")
    earlier = chosen - (_nearest(log, times, before) or 0) if isinstance(before, np.datetime64) else before
    low, high = max(0, chosen - earlier), min(times.size, chosen + frames) - 1
    edges = np.concatenate([times[:1] - 1_000_000_000, (times[1:] + times[:-1]) // 2, times[-1:] + 1_000_000_000])
    start, end = (max(0, int(edges[place]) - log.begin) / 1e9 for place in (low, high + 1))
    stamp = _stamps(log, times, chosen, reach=0).get(int(times[chosen]), int(times[chosen]))
    return Part(start, end, (int(times[chosen]) - log.begin) / 1e9, chosen - low, stamp)


def is_other(log: McapLog, stamps: NDArray[np.int64]) -> bool:
    """Whether a log has left images, but none of those of a run, whose sorted stamps, ns, are given."""
    times = log.file.times(log.channels("left")) if "left" in log.topics else np.zeros(0, np.int64)
    if not (times.size and stamps.size):
        return False
    tried = stamps[[0, stamps.size // 2, -1]].astype("datetime64[ns]")
    places = (place for stamp in tried if (place := _nearest(log, times, stamp)) is not None)
    return not any(np.isin(list(_stamps(log, times, place).values()), stamps).any() for place in places)


def ns_of(at: Instant, begin: int) -> int:
    """An instant in ns, in a log that begins at `begin`, ns."""
    if isinstance(at, float | int):
        return begin + round(at * 1e9)
    value = int(at.astype(f"{at.dtype.kind}8[ns]").astype(np.int64))
    if isinstance(at, np.timedelta64):  # of the first day on which the log has it
        start = begin - MARGIN
        value = start + (value - start) % DAY
    return value


def _nearest(log: McapLog, times: NDArray[np.int64], at: Instant) -> int | None:
    """The place of the left image nearest to an instant; None outside the log. times: log times, ns."""
    when, absolute = ns_of(at, log.begin), not isinstance(at, float | int)
    delay = sum(time - stamp for time, stamp in _stamps(log, times, 0, 0).items()) if absolute else 0
    if not times[0] - MARGIN <= when + delay <= times[-1] + MARGIN:
        return None
    chosen = int(np.argmin(np.abs(times - when - delay)))
    if absolute:
        near = _stamps(log, times, chosen)
        chosen = int(np.searchsorted(times, min(near, key=lambda time: abs(near[time] - when), default=times[chosen])))
    return chosen


def _stamps(log: McapLog, times: NDArray[np.int64], place: int, reach: int = 2) -> dict[int, int]:
    """Log time -> stamp, ns, of the left image at a place and of those within `reach` of it."""
    first, last = times[max(0, place - reach)], times[min(place + reach, times.size - 1)]
    raws = (raw for raw in log.file.messages(log.channels("left"), first, last + 1) if isinstance(raw, RawMessage))
    return {raw.log_time: log.stamp_of(raw) or raw.log_time for raw in raws}


def run_variants(
    logs: Sequence[Path], pipeline: str | Path, changes: Mapping[str, Sequence[str]], place: tuple[Instant, int, int],
    folder: Path, workers: int,
) -> tuple[dict[str, Path], Variants, Part, list[str]]:  # fmt: skip
    """Run all variants over a part of a log; returns their result logs in `folder`, the graphs, the part, and notes.

    pipeline: its name; or a result log of it, which then has the state before the instant; place: instant, frames from
    there on, and frames before it, as for `part_of`; notes: on the state, for a terminal.

    Raises
    ------
    UsageError
        If a run would refuse the log, or the variants cannot be joined.
    """
    from stages.kernel_loading import loading_kernels

    graphs = {label: _graph(pipeline, own) for label, own in changes.items()}
    beside = loading_kernels("recordings.comparison.recording")
    with beside, graphs["A"].source.open(logs) as log, one_thread_per_call():
        graphs = {label: fitted(graph, log) for label, graph in graphs.items()}
        variants, states, notes = merged(graphs), dict[str, Any](), list[str]()
        part = part_of(log, *place)
        if isinstance(pipeline, Path):
            from flow.cli.logged_state import resume  # which imports this module

            first, states, notes = resume(pipeline, (log, logs), graphs, variants, part.stamp)
            part = part_of(log, *place[:2], first)
        log.narrow(part.start, part.end)
        about = {
            "roverflow": product_version(), "log": ", ".join(path.name for path in logs),
            "start": repr(part.start), "end": repr(part.end), "every": "",
        }  # fmt: skip
        sinks = tuple((label, _sink(graphs[label], variants, label, changes[label])) for label in graphs)
        paths = {label: folder / f"{label}.mcap" for label in graphs}
        run(replace(variants.graph, sinks=sinks), log, paths, workers=workers, about=about, states=states)
    missing = [label for label, path in paths.items() if not path.exists()]
    if missing:
        raise UsageError(
            f"no frame went through at {part.start:.3f} s; roverflow run --start {part.start:.3f} says why"
        )
    return paths, variants, part, notes


def _graph(pipeline: str | Path, changes: Sequence[str]) -> Graph:
    if isinstance(pipeline, str):
        return load(pipeline, changes)
    from flow.cli.explanation import graph_of  # which imports this module

    return graph_of(pipeline, changes, with_sinks=True)


def summary_lines(variants: Variants, part: Part, frames: int) -> list[str]:
    """What ran, for a terminal."""
    again = [name for label, own in variants.own.items() if label != "A" for name in own]
    once = len(variants.graph.stages) - len(again)
    change = counted(len(variants.own) - 1, "change") if len(variants.own) > 2 else "change"
    before = f", after {counted(part.before, 'frame')} before it" if part.before else ""
    ran = f"{counted(once, 'stage')} run once, {len(again)} again with the {change}"
    return [
        f"{counted(frames, 'frame')} from {part.at:.3f} s on{before}: {ran}",
        f"the change touches {', '.join(dict.fromkeys(again)) or 'no stage'}",
    ]


def _sink(graph: Graph, variants: Variants, label: str, changes: Sequence[str]) -> Any:
    """The result log of a variant."""
    own = {merged_name: name for name, merged_name in variants.names[label].items()}
    about = {"pipeline": graph.text, "overrides": "\n".join(changes)}
    return VariantSink(sink_of(graph, ".mcap"), own, about)
