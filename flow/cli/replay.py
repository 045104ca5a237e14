"""Replays a log through a pipeline for the command line: files in, files out, a progress bar on the terminal."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from flow.contracts import Verdict, as_text
from flow.errors import UsageError
from flow.runtime.frame_selection import Every
from flow.runtime.graph import Graph

RESULT_TYPES = "rosbags.typesys.stores.ros2_jazzy"  # the module of a result log's message types
LIBRARIES = ("numpy", "opencv-python-headless", "numba", "scikit-image", "scipy")  # that decide the bits of a result
ARROW_EXTRA = "pandas"  # which the library of recordings imports, where it is installed


def replay(
    log: Path | str | Sequence[Path | str],
    pipeline: str | Path,
    out: Path | str,
    rrd: Path | str | None,
    *,
    overrides: Sequence[str] = (),
    workers: int = 2,
    start: float | None = None,
    end: float | None = None,
    every: Every | int | None = None,
    rate: float | None = None,
    on_frame: Callable[[bool], None] | None = None,
    live_pipe: int = 0,
    profile: str | None = None,
    desk: str | None = None,
    with_inputs: bool = False,
    resume: bool = False,
) -> dict[str, Any]:
    """Run a log through a pipeline into a result log and, unless None, a rerun recording; returns the summary.

    Parameters
    ----------
    log, pipeline, out, rrd, overrides, workers, start, end, rate, profile, desk, with_inputs, resume
        As of `roverflow run`; `overrides` has the texts of --set.
    every
        2 for every second frame, or `flow.runtime.frame_selection.Every(metres=0.5)`.
    on_frame
        Called after each frame, with whether it is complete, in place of a progress bar.
    live_pipe
        File descriptor that gets the recording while it is written; 0: none.

    Examples
    --------
    >>> replay("traverse.mcap", "rover", "nav.mcap", None, overrides=["disparities=128"])["verdict"]  # doctest: +SKIP
    'COMPLETE'
    """
    from flow.cli.checkpoint_file import CheckpointFile, checkpoint_of, only_run_of, remove_checkpoint
    from flow.config import loader as pipelines
    from flow.runtime.interrupts import Stop, interrupts
    from flow.runtime.run import run
    from stages.kernel_loading import loading_kernels

    if resume and rate is not None:
        raise UsageError("--resume is for runs as fast as possible; leave out --rate")
    every = every if every is None or isinstance(every, Every) else Every(every)
    graph = pipelines.load(pipeline, overrides)
    logs = (Path(log),) if isinstance(log, Path | str) else tuple(map(Path, log))
    files = _files(graph, logs)
    inputs = tuple(map(str, logs)) if with_inputs else ()
    given = {"live_pipe": live_pipe, "profile": profile, "desk": desk, "inputs": inputs}
    given |= {"limits": _limits(graph), "finals": _final_disparities(graph)}
    graph = replace(graph, sinks=tuple((use, _with(sink, given)) for use, sink in graph.sinks))
    outputs = _outputs(graph, {".mcap": Path(out), ".rrd": Path(rrd) if rrd is not None else None})
    written = [Path(out), *([Path(rrd)] if rrd is not None else [])]
    stop = Stop()
    drawing = () if rrd is None else ("recordings.sinks.rerun_recording", ARROW_EXTRA)
    with (
        loading_kernels(RESULT_TYPES, *drawing),
        graph.source.open(log, start=start, end=end) as opened,
        one_thread_per_call(),
        only_run_of(Path(out)) if resume or checkpoint_of(Path(out)).exists() else nullcontext(),
    ):
        about = _about(graph, logs, files, start, end, every)
        hidden = on_frame is not None or not sys.stderr.isatty()
        with _progress_bar(_frames(opened.frames, every), hidden) as (advance, say), interrupts(stop, say):
            settings: dict[str, Any] = {"workers": workers, "every": every, "rate": rate}
            if resume:
                recording = os.path.relpath(rrd, Path(out).parent) if rrd is not None else ""
                chosen = repr((recording, profile, desk, with_inputs))
                facts = about | {"outputs": chosen, "modules": _modules(pipeline)}
                settings["checkpoints"] = CheckpointFile(Path(out), facts, say)
            else:
                remove_checkpoint(written)
            summary = run(graph, opened, outputs, **settings, about=about, stop=stop, on_frame=on_frame or advance)
            if not summary["interrupted"] or summary["verdict"] == Verdict.COMPLETE:
                remove_checkpoint(written)
    return as_json(summary | {"overrides": list(overrides)})


def _modules(pipeline: str | Path) -> str:
    """The digests of the modules beside a pipeline file of the user's own, which may have its stages."""
    from flow.config.loader import modules_beside, pipeline_file
    from flow.config.templates import SHIPPED
    from recordings.containers.digest import digest_lines

    file = pipeline_file(pipeline)
    return "" if file.parent == SHIPPED else "\n".join(digest_lines(modules_beside(file)))


def _about(
    graph: Graph, logs: Sequence[Path], files: Sequence[Path], start: float | None,
    end: float | None, every: Every | None,
) -> dict[str, str]:  # fmt: skip
    """The facts of a run that its outputs contain. logs: as the user gave them; files: of these."""
    from recordings.containers.digest import digest_lines, log_digest
    from recordings.scoring.result_log import names_of

    about = {
        "pipeline": graph.text,
        "overrides": "\n".join(graph.changes),
        "log": names_of(logs),
        "log_digest": log_digest(files) if files else "",
        "files": "\n".join(digest_lines(getattr(graph.source, "files", ()))),
        "start": "" if start is None else repr(float(start)),
        "end": "" if end is None else repr(float(end)),
        "every": "" if every is None else str(every),
        **versions(),
    }
    return {key: as_text(value) for key, value in about.items()}


@contextmanager
def _progress_bar(total: int | None, hidden: bool) -> Iterator[tuple[Callable[[bool], None], Callable[[str], None]]]:
    """A progress bar: what advances it by a frame, complete or not, and what prints a sentence above it."""
    from tqdm import tqdm

    drops = 0

    def advance(complete: bool) -> None:
        nonlocal drops
        drops += not complete
        bar.set_postfix(dropped=drops, refresh=False)
        bar.update()

    with tqdm(total=total, unit="frame", disable=hidden) as bar:
        yield advance, lambda sentence: bar.write(f"roverflow: {sentence}", file=sys.stderr)


def _files(graph: Graph, logs: Sequence[Path]) -> Sequence[Path]:
    """The files of the logs, which the product's own source also finds in folders.

    Raises LogError for a file that is already a result, which may contain its inputs.
    """
    from recordings import McapSource
    from recordings.containers.finding import find_files
    from recordings.errors import LogError
    from recordings.scoring.result_log import about_run

    if not isinstance(graph.source, McapSource):
        return [file for file in logs if file.is_file()]
    files = [file for file in find_files(logs).files if file.is_file()]
    for file in files:
        if about := about_run(file):
            named = about.get("log") or "which it does not name"
            raise LogError(f"{file} contains results; run the log that they were made from, {named}")
    return files


def _final_disparities(graph: Graph) -> tuple[str, ...]:
    """The streams of disparities that no other disparity is made from."""
    from stages.data import Disparity

    made = [node for node in graph.stages if graph.kinds.get(node.name) is Disparity]
    read = {stream for node in made for stream in node.inputs.values()}
    return tuple(node.name for node in made if node.name not in read)


def _limits(graph: Graph) -> tuple[str, ...]:
    """The limits of the layers of elevation maps, as `RerunSink.limits` has them."""
    from stages import Binarise
    from stages.terrain.verdict_limits import limits_of

    rules = [(node.inputs["elevation"], node.actor) for node in graph.nodes if isinstance(node.actor, Binarise)]
    return tuple(f"{stream}/{name}={limit:g}" for stream, rule in rules for name, limit in limits_of(rule).items())


def _with(sink: Any, given: Mapping[str, Any]) -> Any:
    """A sink with those of the given values that it has a field for."""
    return replace(sink, **{name: value for name, value in given.items() if value and hasattr(sink, name)})


def _frames(of_log: int | None, every: Every | None) -> int | None:
    """The number of frames to come, None if unknown."""
    if of_log is None or every is None:
        return of_log
    return None if every.metres is not None else -(-of_log // every.frames)


@contextmanager
def one_thread_per_call() -> Iterator[None]:
    """Let OpenCV, BLAS and OpenMP use one thread in each call: frames in flight fill the cores."""
    import cv2
    from threadpoolctl import threadpool_limits

    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        cv2.setNumThreads(threads)


def _outputs(graph: Graph, paths: Mapping[str, Path | None]) -> dict[str, Path]:
    """Sink class -> the path that it writes to, by the suffix of its files; a sink without a path is not used."""
    endings = [sink.suffix for _, sink in graph.sinks]
    for use, sink in graph.sinks:
        if sink.suffix not in paths:
            raise UsageError(f"{use} writes {sink.suffix} files, but a run writes only {' and '.join(paths)} files")
        if endings.count(sink.suffix) > 1:
            raise UsageError(f"several sinks write {sink.suffix} files, but a run writes only one; keep one")
    used = {use: path for use, sink in graph.sinks if (path := paths[sink.suffix]) is not None}
    if not used:
        raise UsageError(f"the pipeline writes only {' and '.join(endings)} files, and the run is to write none")
    return used


def as_json(summary: dict[str, Any]) -> dict[str, Any]:
    """The summary of a run without the entry objects for sinks; "ledger" holds them as plain values."""
    return {name: value for name, value in summary.items() if name != "entries"}


def versions() -> dict[str, str]:
    """The versions of what results depend on."""
    return {"roverflow": product_version(), **{name: version(name) for name in LIBRARIES}}


def product_version() -> str:
    """The version of the installed product."""
    try:
        return version("roverflow")
    except PackageNotFoundError:
        return "unknown"
