"""A log through a pipeline as one asks for it on the command line: files in, files out, a bar on the terminal.

The rest of the runtime knows no paths of pipelines, no terminal and no libraries whose threads must be held back.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from flow.errors import UsageError
from flow.runtime.graph import Graph


def replay(
    log: Path,
    pipeline: str,
    out: Path,
    rrd: Path | None,
    *,
    overrides: Sequence[str] = (),
    workers: int = 2,
    start: float | None = None,
    end: float | None = None,
) -> dict[str, Any]:
    """Run a log through a pipeline into a result log and, unless None, a rerun recording; returns the summary."""
    import cv2
    from threadpoolctl import threadpool_limits
    from tqdm import tqdm

    from flow.config import loader as pipelines
    from flow.runtime.run import Stop, interrupts, run

    graph = pipelines.load(pipeline, overrides)
    outputs = _outputs(graph, {".mcap": out, ".rrd": rrd})
    cv2.setNumThreads(1)  # frames in flight fill the cores, not threads inside one call
    stop = Stop()
    with graph.source.open(log, start=start, end=end) as opened, threadpool_limits(1):
        about = {
            "roverflow": product_version(),
            "pipeline": graph.text,
            "overrides": "\n".join(overrides),
            "log": log.name,
            "start": "" if start is None else repr(float(start)),
            "end": "" if end is None else repr(float(end)),
            **{name: version(name) for name in ("numpy", "opencv-python-headless", "numba", "scikit-image")},
        }
        about = {key: value.encode("utf-8", "replace").decode() for key, value in about.items()}  # odd names of files
        with tqdm(total=opened.frames, unit="frame", disable=not sys.stderr.isatty()) as bar:
            drops = 0

            def on_frame(whole: bool) -> None:
                nonlocal drops
                drops += not whole
                bar.set_postfix(dropped=drops, refresh=False)
                bar.update()

            with interrupts(stop, lambda sentence: bar.write(f"roverflow: {sentence}", file=sys.stderr)):
                summary = run(graph, opened, outputs, workers=workers, about=about, stop=stop, on_frame=on_frame)
    return as_json(summary | {"overrides": list(overrides)})


def _outputs(graph: Graph, paths: Mapping[str, Path | None]) -> dict[str, Path]:
    """Sink -> the path that it writes to, by what its files end in; those without one stay unused."""
    endings = [sink.suffix for _, sink in graph.sinks]
    for use, sink in graph.sinks:
        if sink.suffix not in paths:
            raise UsageError(f"{use} writes {sink.suffix} files, and a run has outputs for {' and '.join(paths)} only")
        if endings.count(sink.suffix) > 1:
            raise UsageError(f"several sinks write {sink.suffix} files, and a run has one output for them; leave one")
    return {use: path for use, sink in graph.sinks if (path := paths[sink.suffix]) is not None}


def as_json(summary: dict[str, Any]) -> dict[str, Any]:
    """A run's summary without the ledger's entry objects; "ledger" has them as plain values."""
    return {name: value for name, value in summary.items() if name != "entries"}


def product_version() -> str:
    """The version of the installed product."""
    try:
        return version("roverflow")
    except PackageNotFoundError:
        return "unknown"
