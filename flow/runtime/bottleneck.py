"""What limits the rate of a run: the slowest stage, the slowest sink, and what another worker would bring.

Work that takes one frame at a time cannot take less time than the sum of its frames, with any number of workers. All
other work divides among the workers. So a run of n workers takes at least `max(all work / n, serial work)`.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from statistics import median
from typing import Any

MIN_FRAMES_PER_WORKER = 4  # with fewer frames a run is mostly start and end, and nothing is said about workers
MIN_GAIN = 1.05  # a smaller ratio of rates is none
READING = "reading the log"


def bottleneck(
    seconds: Mapping[str, float],
    sinks: Collection[str],
    serial: Mapping[str, float],
    workers: int,
    frames: int,
    cores: int,
) -> dict[str, Any]:
    """The names and seconds of the slowest stage and sink, and a sentence about another worker; empty where unknown.

    seconds: stage or sink -> busy time of the run; serial: the same of what takes one frame at a time, sinks and the
    reader of the log included; frames: the number that went through.
    """
    if not frames or not any(seconds.values()):
        return {}
    found: dict[str, Any] = {}
    for kind, names in (("stage", [name for name in seconds if name not in sinks]), ("sink", list(sinks))):
        if names:
            slowest = max(names, key=lambda name: seconds[name])
            found[kind] = {"name": slowest, "seconds_per_frame": round(seconds[slowest] / frames, 6)}
    if frames >= MIN_FRAMES_PER_WORKER * (workers + 1):
        found["another_worker"] = _another_worker(sum(seconds.values()), serial, workers, cores)
    return found


def latency(seconds: Sequence[float]) -> dict[str, float]:
    """Median and maximum of the times from when a frame was due until its stages were through; empty without a frame.

    Sinks and stages that wait for the next frame do not count.
    """
    return {"median": round(median(seconds), 6), "maximum": round(max(seconds), 6)} if seconds else {}


def _another_worker(busy: float, serial: Mapping[str, float], workers: int, cores: int) -> str:
    """What one more worker would bring, in words. busy: seconds of all work."""
    longest = max(serial, key=lambda name: serial[name])
    bound = serial[longest]
    if workers >= cores:
        return f"another worker would not help, because each of the {cores} cores has one"
    gain = max(busy / workers, bound) / max(busy / (workers + 1), bound)
    if gain < MIN_GAIN:
        return f"another worker would not help, because {_shown(longest)} takes one frame at a time"
    return f"another worker would give up to {gain - 1:.0%} more frames/s"


def usable_cores() -> int:
    """The number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _shown(name: str) -> str:
    """The name of a stream as it is, of a sink without its module."""
    return name.rpartition(".")[2]


def bottleneck_line(found: Mapping[str, Any]) -> str:
    """The bottleneck of a summary in one line; empty where it is unknown."""
    parts = []
    for kind in ("stage", "sink"):
        if kind in found:
            name, milliseconds = _shown(found[kind]["name"]), 1000 * found[kind]["seconds_per_frame"]
            parts.append(f"slowest {kind}: {name}, {milliseconds:.0f} ms a frame")
    return "; ".join([*parts, *filter(None, [found.get("another_worker")])])
