"""`roverflow fleet`: many logs through one pipeline, on the processes of this machine or a Dask cluster."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from flow.cli.arguments import count, memory, workers
from flow.cli.outputs import add_pipeline_options, check_used
from flow.cli.report import say
from flow.contracts import as_text, counted
from flow.errors import COMPLETE, INCOMPLETE, UsageError
from recordings.atomic_write import writing

if TYPE_CHECKING:
    from flow.cli.fleet.catalogue import Catalogue
    from flow.cli.fleet.jobs import Job
    from flow.cli.fleet.task import Pipeline

HELP = "run many logs through a pipeline, and keep a catalogue of their results"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    logs = "logs, folders of logs, glob patterns, or text files that list them"
    sub.add_argument("logs", nargs="*", metavar="LOG", help=logs)
    sub.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results and the catalogue")
    add_pipeline_options(sub)
    sub.add_argument("--rrd", action="store_true", help="write a rerun recording beside each result")
    one = "threads of each log; a process runs one log at a time (2)"
    sub.add_argument("--workers-per-log", type=workers, default=2, metavar="N", help=one)
    sub.add_argument("--processes", type=workers, metavar="N", help="worker processes (cores / workers per log)")
    ends = "memory limit of a worker process, which is ended beyond it (4GB)"
    sub.add_argument("--memory", type=memory, default="4GB", metavar="SIZE", help=ends)
    address = "address of the scheduler of a running Dask cluster, tcp://... or tls://..."
    sub.add_argument("--cluster", metavar="ADDRESS", help=address)
    sub.add_argument("--dashboard", action="store_true", help="show Dask's dashboard on http://127.0.0.1:8787")
    stall = "time without a new frame after which a log counts as hung (600)"
    sub.add_argument("--stall", type=count, default=600, metavar="SECONDS", help=stall)
    sub.add_argument("--watch", action="store_true", help="show the progress of the fleet that runs in --out")


def run(options: argparse.Namespace) -> int:
    """Run what is missing, changed or failed; the exit code is 3 unless every log is COMPLETE."""
    from flow.cli.fleet.catalogue import NAME, Catalogue
    from flow.cli.fleet.jobs import jobs_of
    from flow.cli.fleet.progress import watch
    from flow.cli.fleet.task import Pipeline
    from flow.config.loader import load

    if options.watch:
        return watch(Catalogue(options.out))
    if not options.logs:
        raise UsageError("give logs, folders, glob patterns or a text file that lists them")
    if options.out.is_file():
        raise UsageError(f"{options.out} is a file; give the name of a folder")
    check_used(load(options.pipeline, options.set), {".mcap": [], ".rrd": ["--rrd"] if options.rrd else []})
    pipeline, folder = Pipeline.of(options.pipeline, tuple(options.set)), options.out.absolute()
    jobs = jobs_of(options.logs, folder, Catalogue(folder).rows() if (folder / NAME).is_file() else ())
    with writing(options.out):
        folder.mkdir(parents=True, exist_ok=True)
    catalogue = Catalogue(folder, create=True)
    with catalogue.held():
        _run_due(options, jobs, pipeline, catalogue)
    names = {job.name for job in jobs}
    return _verdict([row for row in catalogue.rows() if row["name"] in names], options.out)


def _run_due(options: argparse.Namespace, jobs: Sequence[Job], pipeline: Pipeline, catalogue: Catalogue) -> None:
    """Say which jobs have to run, and why, and run them."""
    from flow.cli.fleet.engine import Fleet, cluster
    from flow.cli.fleet.jobs import reason_to_run
    from flow.cli.fleet.progress import Progress
    from flow.cli.fleet.task import Task
    from flow.cli.replay import product_version
    from flow.runtime.bottleneck import usable_cores

    folder = catalogue.path.parent
    rows = {row["name"]: row for row in catalogue.rows()}
    same = (pipeline.digest, product_version(), folder, options.rrd)
    why = {job: reason_to_run(job, rows.get(job.name), *same) for job in jobs}
    due = [job for job, reason in why.items() if reason]
    reasons = Counter(filter(None, why.values()))
    size, listed = sum(job.size for job in due) / 1e9, ", ".join(f"{n} {reason}" for reason, n in reasons.items())
    more = f" ({listed}), {size:.2f} GB" if due else ""
    say(f"{counted(len(jobs), 'log')}: {len(jobs) - len(due)} done before, {len(due)} to run{more}")
    places = {job.name: as_text(job.log) for job in jobs if job.name in rows}
    catalogue.put_all({name: {"log": place} for name, place in places.items() if rows[name]["log"] != place})
    if not due:
        return
    tasks = {job.name: Task(job, folder, pipeline, options.rrd, options.workers_per_log) for job in due}
    processes = options.processes or max(1, usable_cores() // options.workers_per_log)
    with (
        cluster(
            options.cluster, min(processes, len(due)), options.workers_per_log, options.memory, options.dashboard
        ) as client,
        Progress({job.name: job.size for job in due}) as progress,
    ):
        Fleet(catalogue, tasks, progress, stall_seconds=options.stall).run(client)


def _verdict(rows: list[dict[str, object]], folder: Path) -> int:
    """Print how many logs ended how."""
    from flow.cli.fleet.catalogue import outcome

    ended = Counter(map(outcome, rows))
    counts = ", ".join(f"{number} {name}" for name, number in sorted(ended.items()))
    say(f"{counts}; roverflow list {folder} lists them")
    return COMPLETE if set(ended) <= {"COMPLETE"} else INCOMPLETE
