"""`roverflow fleet`: many logs through one pipeline, on the processes of this machine or a Dask cluster."""

from __future__ import annotations

import argparse
import os
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from flow.cli.arguments import count, workers
from flow.cli.outputs import add_pipeline_options
from flow.cli.report import say
from flow.contracts import counted
from flow.errors import COMPLETE, INCOMPLETE, UsageError

if TYPE_CHECKING:
    from flow.cli.fleet.catalogue import Catalogue

HELP = "run many logs through a pipeline, and keep a catalogue of their results"
WATCH_SECONDS = 2.0


def add_arguments(sub: argparse.ArgumentParser) -> None:
    logs = "logs, folders of logs, patterns, or text files that list them"
    sub.add_argument("logs", nargs="*", metavar="LOG", help=logs)
    sub.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the results and the catalogue")
    add_pipeline_options(sub)
    sub.add_argument("--rrd", action="store_true", help="write a rerun recording beside each result")
    one = "threads of each log; a process runs one log at a time (2)"
    sub.add_argument("--workers-per-log", type=workers, default=2, metavar="N", help=one)
    sub.add_argument("--processes", type=workers, metavar="N", help="worker processes (cores / workers per log)")
    sub.add_argument("--memory", default="4GB", metavar="SIZE", help="memory at which a worker process ends (4GB)")
    address = "scheduler of a Dask cluster that exists, tcp://... or tls://..."
    sub.add_argument("--cluster", metavar="ADDRESS", help=address)
    sub.add_argument("--dashboard", action="store_true", help="show Dask's dashboard on http://127.0.0.1:8787")
    stall = "a log without a new frame for that long counts as hung (600)"
    sub.add_argument("--stall", type=count, default=600, metavar="SECONDS", help=stall)
    sub.add_argument("--watch", action="store_true", help="show the fleet of --out that another terminal runs")


def run(options: argparse.Namespace) -> int:
    """Run what is missing, changed or failed; the exit code is 3 unless every log is COMPLETE."""
    from flow.cli.fleet.catalogue import Catalogue

    if options.watch:
        return _watch(Catalogue(options.out))
    from flow.cli.fleet.engine import Fleet, cluster, tasks_of
    from flow.cli.fleet.jobs import jobs_of, reason_to_run
    from flow.cli.fleet.task import Pipeline
    from flow.cli.replay import product_version
    from flow.config.loader import load

    if not options.logs:
        raise UsageError("give logs, folders, patterns or a text file of them")
    load(options.pipeline, options.set)
    pipeline, folder = Pipeline.of(options.pipeline, tuple(options.set)), options.out.absolute()
    jobs = jobs_of(options.logs, folder)
    folder.mkdir(parents=True, exist_ok=True)
    catalogue = Catalogue(folder, create=True)
    rows = {row["name"]: row for row in catalogue.rows()}
    why = {job: reason_to_run(job, rows.get(job.name), pipeline.digest, product_version(), folder) for job in jobs}
    due = [job for job, reason in why.items() if reason]
    reasons = {reason: sum(other == reason for other in why.values()) for reason in why.values() if reason}
    size, listed = sum(job.size for job in due) / 1e9, ", ".join(f"{n} {reason}" for reason, n in reasons.items())
    more = f" ({listed}), {size:.2f} GB" if due else ""
    say(f"{counted(len(jobs), 'log')}: {len(jobs) - len(due)} done before, {len(due)} to run{more}")
    if due:
        tasks = tasks_of(due, folder, pipeline, options.rrd, options.workers_per_log)
        processes = options.processes or max(1, (os.cpu_count() or 1) // options.workers_per_log)
        fleet = Fleet(folder, catalogue, tasks, say, stall_seconds=options.stall)
        with cluster(options.cluster, min(processes, len(due)), options.memory, options.dashboard) as client:
            fleet.run(client)
    names = {job.name for job in jobs}
    return _verdict([row for row in catalogue.rows() if row["name"] in names], options.out)


def _verdict(rows: list[dict[str, object]], folder: Path) -> int:
    """Print how many logs ended how."""
    ended = [str(row["verdict"] if row["state"] == "done" else row["state"]) for row in rows]
    say(
        ", ".join(f"{ended.count(name)} {name}" for name in dict.fromkeys(sorted(ended)))
        + f"; roverflow list {folder} lists them"
    )
    return COMPLETE if set(ended) <= {"COMPLETE"} else INCOMPLETE


def _watch(catalogue: Catalogue) -> int:
    """Print each log that ends, and the states whenever they change, until nothing waits or runs."""
    from flow.cli.fleet.engine import line_of
    from recordings.containers.finding import RESULT_ENDING

    shown, known = "", {row["name"]: row["ended"] for row in catalogue.rows()}
    while True:
        rows = catalogue.rows(sort="ended, name")
        active = [row for row in rows if row["state"] in ("waiting", "running")]
        for row in rows:
            if row not in active and row["ended"] != known.get(row["name"]):
                say(f"{row['name']}: {line_of(row)}")
                known[row["name"]] = row["ended"]
        frames = sum(row["frames"] or 0 for row in rows if row not in active)
        for row in active:
            with suppress(OSError, ValueError):  # it has not begun, or ends just now
                progress = catalogue.path.parent / f"{row['name']}{RESULT_ENDING}.progress"
                frames += int(progress.read_text()) - 1
        states = [str(row["state"]) for row in rows]
        line = ", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(sorted(states)))
        line += f"; {counted(frames, 'frame')} so far, {sum(row['bytes'] for row in active) / 1e9:.2f} GB left"
        if line != shown:
            say(line)
            shown = line
        if not active:
            return COMPLETE
        time.sleep(WATCH_SECONDS)
