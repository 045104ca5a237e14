"""What a worker does: one log through the pipeline, as `roverflow run` does it. Only paths and summaries travel."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import sys
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from flow.cli.checkpoint_file import checkpoint_of, is_being_written
from flow.cli.fleet.jobs import UNREADABLE, Job
from flow.cli.fleet.progress import is_progress
from flow.cli.replay import LIBRARIES, product_version, replay
from flow.cli.report import by_cause
from flow.config.loader import load, modules_beside, shipped
from flow.config.templates import SHIPPED
from flow.contracts import Severity, Verdict
from flow.errors import RoverflowError, SinkError, UsageError
from flow.runtime.findings import lines
from recordings.atomic_write import unfinished, writing
from recordings.containers.digest import digest_lines
from recordings.containers.finding import RESULT_ENDING
from recordings.errors import LogError, UnwritableError

MAX_FILE_BYTES = 4 << 20  # of a file beside a pipeline that travels with it
_TRAVELLED = f"roverflow-{os.getuid()}-"  # begins the names of folders of pipelines that travelled


@dataclass(frozen=True)
class Pipeline:
    """A pipeline that travels. name: of a shipped one, or of its file; files: path in its folder -> content."""

    name: str
    files: Mapping[str, bytes]
    changes: tuple[str, ...]
    named: tuple[str, ...] = ()  # digests of the files that settings name

    @classmethod
    def of(cls, name: str, changes: tuple[str, ...]) -> Pipeline:
        """The pipeline `name`, which `load` accepts; a file takes the modules beside it along."""
        named = tuple(digest_lines(getattr(load(name, changes).source, "files", ())))
        if name in shipped():
            return cls(name, {}, changes, named)
        path = Path(name)
        beside = [file for file in (path, *modules_beside(path)) if file.stat().st_size <= MAX_FILE_BYTES]
        small = {str(file.relative_to(path.parent)): file.read_bytes() for file in beside}
        return cls(path.name, small, changes, named)

    @property
    def label(self) -> str:
        """Its name and changes."""
        return " ".join([self.name, *self.changes])

    @property
    def digest(self) -> str:
        """Of everything that decides what the pipeline does, besides the version."""
        text = b"".join(f"{name} {len(data)} ".encode() + data for name, data in sorted(self.files.items()))
        if not self.files:
            parts = sorted((SHIPPED / "parts").glob("*.yaml"))
            text = b"".join(file.read_bytes() for file in (SHIPPED / f"{self.name}.yaml", *parts))
        return hashlib.sha256(text + "\n".join((*self.changes, *self.named)).encode()).hexdigest()[:16]

    def local(self) -> str:
        """Its name or file on this machine."""
        if not self.files:
            return self.name
        folder = Path(tempfile.gettempdir()) / f"{_TRAVELLED}{self.digest}"
        folder.mkdir(mode=0o700, exist_ok=True)
        _forget_others(folder)
        for name, data in self.files.items():
            file = folder / name
            if not file.exists() or file.read_bytes() != data:
                file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                partial = file.with_name(f".{file.name}.{os.getpid()}")
                partial.write_bytes(data)
                partial.replace(file)
        return str(folder / self.name)


def _forget_others(folder: Path) -> None:
    """Forget modules that travelled with other pipelines: a worker that stays has them from an earlier fleet."""
    for name, module in sys.modules.copy().items():  # another thread may import
        homes = {home.name for home in Path(getattr(module, "__file__", None) or "").parents}
        if any(home.startswith(_TRAVELLED) and home != folder.name for home in homes):
            del sys.modules[name]
    sys.path[:] = [path for path in sys.path if not Path(path).name.startswith(_TRAVELLED) or path == str(folder)]


@dataclass(frozen=True)
class Task:
    """A job to run. folder: of the fleet; recording: also write a rerun recording; workers: threads."""

    job: Job
    folder: Path
    pipeline: Pipeline
    recording: bool
    workers: int

    @property
    def result(self) -> Path:
        """The result log."""
        return self.folder / f"{self.job.name}{RESULT_ENDING}.mcap"

    @property
    def note(self) -> Path:
        """The summary beside the result, by which a finished log is recognised."""
        return self.result.with_suffix(".json")

    @property
    def progress(self) -> Path:
        """A file that contains the number of frames so far, while the log runs."""
        return self.result.with_suffix(".progress")

    def identity(self) -> dict[str, str]:
        """What the result depends on."""
        return {"log_digest": self.job.digest, "pipeline_digest": self.pipeline.digest, "version": product_version()}


def run_task(task: Task) -> dict[str, Any]:
    """Run a log; returns the columns of its row in the catalogue. A log that cannot be used is a result.

    A result of the same log, pipeline and version that is there already is taken as it is.
    """
    if (found := _finished(task)) is not None:
        return found
    node = {"node": f"{platform.node()}:{os.getpid()}"}
    if why := _absent(task):  # no fault of the log
        return task.identity() | node | {"state": "failed", "why": f"{platform.node()} {why}"}
    try:
        _prepare(task)
        summary = _run(task)
    except Exception as error:  # the log, a stage of the user's own, or the disk
        usable = isinstance(error, UnwritableError) or not isinstance(error, UsageError | LogError)
        known = isinstance(error, RoverflowError | LogError)
        why = str(error) if known else f"{type(error).__name__}: {error}"
        return task.identity() | node | {"state": "failed" if usable else "unusable", "why": why}
    finally:
        with suppress(OSError):
            if is_progress(task.progress):
                task.progress.unlink()
    if not checkpoint_of(task.result).exists():
        remove_unfinished(task)
    row = task.identity() | node | _columns(summary)
    partial = task.result.with_name(f"{task.result.name}.{os.getpid()}-note.partial")
    partial.write_text(json.dumps({"row": row, "summary": summary}, indent=2))
    partial.replace(task.note)
    return row


def _prepare(task: Task) -> None:
    """Make the folder of the result, and remove what a worker that died has left.

    Raises UnwritableError where files of others are, or if the names are too long.
    """
    with writing(task.result):
        task.result.parent.mkdir(parents=True, exist_ok=True)
        dead = not checkpoint_of(task.result).exists() and not is_being_written(task.result)
    own = {task.note: _note(task) is not None, task.progress: is_progress(task.progress)}
    for file, ours in own.items():
        if file.exists() and not ours:
            raise UnwritableError(f"{file} is not a file of a fleet; rename it, or choose another --out")
    if dead:
        remove_unfinished(task)


def _run(task: Task) -> dict[str, Any]:
    """The summary of the run."""
    done = 0

    def count(complete: bool) -> None:
        nonlocal done
        done += 1
        with suppress(OSError):
            task.progress.write_text(str(done))

    count(True)
    recording = task.result.with_suffix(".rrd") if task.recording else None
    log, pipeline, changes = task.job.log, task.pipeline.local(), task.pipeline.changes
    options: dict[str, Any] = {"overrides": changes, "workers": task.workers, "on_frame": count}
    try:
        return replay(log, pipeline, task.result, recording, **options, resume=True)
    except (UsageError, SinkError) as error:
        summary = getattr(error, "summary", {})
        if summary.get("frames_through") != summary.get("frames_resumed"):  # it went on, and failed later
            raise
    # The pipeline cannot be resumed, or has changed, or what a worker has written that died is gone.
    return replay(log, pipeline, task.result, recording, **options)


def remove_unfinished(task: Task) -> None:
    """Remove what workers that died have left of the task's outputs."""
    for suffix in (".mcap", ".rrd"):
        for left in unfinished(task.result.with_suffix(suffix)):
            with suppress(OSError):
                left.unlink()


def _columns(summary: Mapping[str, Any]) -> dict[str, Any]:
    """The row of a summary."""
    found, interrupted = summary["surveys"] | summary["findings"], summary["interrupted"]
    return {
        "state": "failed" if interrupted else "done", "verdict": summary["verdict"], "frames": summary["frames_in"],
        "complete": summary["frames_out"], "losses": summary["drops"],
        "findings": {name: f"{item['severity']}: {item['sentence']}" for name, item in found.items()},
        "seconds": summary["wall_seconds"], "cpu_seconds": summary["cpu_seconds"],
        "stage_seconds": sum(summary["cpu_seconds_of"].values()) + summary["survey_cpu_seconds"],
        "why": _why(summary, found),
        "result": Path(summary["outputs"][0]).name if summary["outputs"] else None,
    }  # fmt: skip


def _why(summary: Mapping[str, Any], found: Mapping[str, Mapping[str, str]]) -> str:
    """Why a run is incomplete: its faults, and of each kind of loss the number and the first; empty if complete."""
    if summary["verdict"] == Verdict.COMPLETE:
        return ""
    first = {entry["reason"]: f"{entry['stream']}: {entry['detail']}" for entry in reversed(summary["ledger"])}
    drops = [f"{number} {reason}, first: {first[reason]}" for reason, number in by_cause(summary["drops"])]
    return "; ".join([*lines(found, Severity.FAULT), *drops])


def _finished(task: Task) -> dict[str, Any] | None:
    """The row of an earlier run of the same, if its files are there."""
    row = _note(task)
    if row is None:
        return None
    same = all(row.get(name) == value for name, value in task.identity().items())
    files = [task.result, *([task.result.with_suffix(".rrd")] if task.recording else [])]
    there = row["result"] is None or all(file.is_file() for file in files)
    return row if same and row["state"] == "done" and there else None


def _note(task: Task) -> dict[str, Any] | None:
    """The row in the summary beside the result; None if there is none, or a file of another kind."""
    try:
        row = json.loads(task.note.read_text())["row"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return row if isinstance(row, dict) else None


def about_worker(task: Task) -> dict[str, str]:
    """What must be the same on all workers."""
    from llvmlite import binding

    libraries = {name: version(name) for name in LIBRARIES}
    target = binding.get_process_triple()
    return {"version": product_version(), "pipeline": task.pipeline.digest, "numba target": target} | libraries


def _absent(task: Task) -> str:
    if task.job.log.exists() or task.job.digest == UNREADABLE:  # which the run reports
        return ""
    return f"has no {task.job.log}; paths must mean the same on all machines"


def unfit(task: Task) -> str:
    """Why this machine cannot run a task, or nothing."""
    if why := _absent(task):
        return why
    try:
        load(task.pipeline.local(), task.pipeline.changes)
    except RoverflowError as error:
        return f"cannot load the pipeline: {error}"
    return ""
