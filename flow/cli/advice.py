"""What `roverflow info` recommends: the command to type, what it will cost, and the settings that a log needs."""

from __future__ import annotations

import os
import re
import shlex
from argparse import Namespace
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any

import yaml

from flow.cli.outputs import default_result
from flow.cli.report import duration
from flow.config.loader import load, pipeline_file
from flow.contracts import counted
from flow.errors import PipelineError, UsageError
from flow.runtime.graph import Graph
from flow.runtime.run import fitted
from flow.units import as_written
from recordings.inventory.search_range import ROCK

if TYPE_CHECKING:
    from recordings.source.log import McapLog
    from recordings.source.settings import LogSettings

# CPU seconds of a frame: at any size, and for each megapixel of the left image (`make bench`, docs/benchmarks.md)
_SECONDS = {"fast": (0.15, 0.26), "rover": (0.15, 0.33), "accurate": (0.15, 0.55), "paper": (0.2, 4.8)}
AMPLE = 1.5  # times the range that is enough, from which a smaller one is recommended
_STARTING_SECONDS = 2.0  # before the first frame
# Megabytes of a frame: at any size, and for each megapixel of the left image
_LOG_MB, _RECORDING_MB = (0.9, 2.0), (0.57, 0.41)
_COMMENTS = re.compile(r"(^(#.*)?\n)*\Z", re.MULTILINE)  # before the next key, to which they belong


def refusal_of(graph: Graph, log: McapLog) -> str:
    """Why a run would refuse a log; empty if it would not."""
    try:
        fitted(graph, log)
    except UsageError as error:
        return str(error)
    return ""


def advice(options: Namespace, description: Mapping[str, Any], graph: Graph) -> list[str]:
    """The command that runs the log, its time and the sizes of its outputs, and a search range if another is needed."""
    pipeline = [] if options.pipeline == "rover" else ["-p", options.pipeline]
    changes = [part for change in options.set for part in ("--set", change)]
    lines = [f"  {shlex.join(['roverflow', 'run', *map(str, options.log), *pipeline, *changes])}"]
    if line := _costs(options.pipeline, description):
        lines.append(f"  {line}; it writes {default_result(options.log).name} beside the log")
    return lines + _range_advice(description["search_range"], graph, options)


def remedies(description: Mapping[str, Any]) -> list[str]:
    """Settings that supply what is missing: one line each; each is enough."""
    known = description["remedies"]
    given = [
        remedy
        for stream in known
        if description["missing"][stream] in description["refused"]
        for remedy in known[stream]
    ]
    lines = [f"  {_settings(remedy['settings'])}{_note(remedy['condition'])}" for remedy in given]
    return ["what would supply it:", *dict.fromkeys(lines)] if lines else []


def pipeline_for(pipeline: str, source: LogSettings, log: McapLog) -> str:
    """The text of a pipeline file whose source names the topics of a log; what is missing is in its comments.

    Raises UsageError if the pipeline has no `source` at the beginning of a line.
    """
    resolution = log.resolution
    own = {
        item.name: getattr(source, item.name) for item in fields(source) if getattr(source, item.name) != item.default
    }
    given = {role: topic for role, topic in resolution.chosen.items() if role not in own}
    lines = ["source:", "  use: recordings.McapSource"]
    lines += [f"  {name}: {_flow(value)}" for name, value in {**given, **own}.items()]
    for stream, why in log.missing.items():
        lines.append(f"  # {stream}: {why}")
        for remedy in resolution.remedies.get(stream, ()):
            lines.append(f"  # either{_note(remedy.condition)}:")
            lines += [f"  #   {name}: {_flow(value)}" for name, value in remedy.settings.items()]
    file = pipeline_file(pipeline)
    text = file.read_text(encoding="utf-8")
    root: Any = yaml.compose(text)
    starts = {key.value: key.start_mark for key, _ in root.value}
    start = starts["source"].index
    if root.flow_style or starts["source"].column:
        raise UsageError(f"{file} has no 'source:' at the beginning of a line; write it so")
    end = min((mark.index for mark in starts.values() if mark.index > start), default=len(text))
    end = start + len(_COMMENTS.sub("", text[start:end], count=1))
    return text[:start] + "\n".join(lines) + "\n" + text[end:]


def _costs(pipeline: str, description: Mapping[str, Any]) -> str:
    """The time and the sizes that a run will take; empty for a pipeline of the user's own."""
    frames, camera, cores = description["frames"]["pairs"], description["calibration"], os.cpu_count() or 1
    if pipeline not in _SECONDS or camera is None:
        return ""
    megapixels = camera["width"] * camera["height"] / 1e6
    seconds, log, recording = (
        frames * (fixed + each * megapixels) for fixed, each in (_SECONDS[pipeline], _LOG_MB, _RECORDING_MB)
    )
    time = duration(_STARTING_SECONDS + seconds / cores)
    return (
        f"{counted(frames, 'frame')}: about {time} on {counted(cores, 'core')}; result log about {_size(log)}, "
        f"recording about {_size(recording)}"
    )


def _range_advice(found: Mapping[str, Any] | None, graph: Graph, options: Namespace) -> list[str]:
    """What to set if the ground has more disparities than the pipeline searches, or by far fewer."""
    ranges = {node.name: node.actor.disparities for node in graph.nodes if hasattr(node.actor, "disparities")}
    if found is None or found["doubt"] or not ranges:
        return []
    widest = max(ranges, key=ranges.__getitem__)
    searched = ranges[widest]
    if searched >= AMPLE * found["range_px"]:
        what, gain = f"ground and rocks of {ROCK} m need fewer than {searched} disparities", "runs faster"
    elif found["ground_px"] < searched:
        return []
    else:
        what, gain = f"near ground lies beyond the {searched} disparities searched at full size", "includes it"
    return [f"  {what}: --set {_range_setting(options, widest, round(found['range_px']))} {gain}"]


def _range_setting(options: Namespace, stream: str, value: int) -> str:
    """The setting of a pipeline that gives a stream a search range: one for all, of its template, or its own."""
    for owner in ("", f"{stream.partition('/')[0]}."):
        with suppress(PipelineError):
            load(options.pipeline, [*options.set, f"{owner}disparities={value}"])
            return f"{owner}disparities={value}"
    return f"{stream}.disparities={value}"


def _settings(values: Mapping[str, Any]) -> str:
    """Settings of the source as options of a command."""
    return " ".join(f"--set {shlex.quote(f'source.{name}={_flow(value)}')}" for name, value in values.items())


def _flow(value: Any) -> str:
    """A value as YAML in one line."""
    value = list(value) if isinstance(value, tuple) else value
    if is_dataclass(value):
        own = [(known, getattr(value, known.name)) for known in fields(value)]
        changed = {known.name: (part, known.metadata["unit"]) for known, part in own if part != known.default}
        value = {name: as_written(part, unit) if unit else part for name, (part, unit) in changed.items()}
    return yaml.safe_dump(value, default_flow_style=True, width=10_000, sort_keys=False).removesuffix("...\n").strip()


def _note(condition: str) -> str:
    return f"  ({condition})" if condition else ""


def _size(megabytes: float) -> str:
    return f"{megabytes:.0f} MB" if megabytes < 1000 else f"{megabytes / 1000:.1f} GB"
