"""Runs the tasks of a fleet on a Dask cluster and keeps the catalogue. The engine's traps are in docs/fleet.md."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from flow.cli.checkpoint_file import remove_checkpoint
from flow.cli.fleet.catalogue import WAITING, Catalogue
from flow.cli.fleet.progress import Progress, frames_so_far, is_progress
from flow.cli.fleet.task import Task, about_worker, remove_unfinished, run_task, unfit
from flow.contracts import as_text, remedy_for
from flow.errors import INCOMPLETE, RoverflowError, UsageError
from flow.runtime.interrupts import Stop, interrupts

POLL_SECONDS = 1.0
CLUSTER_SECONDS = 20.0  # for which a fleet waits for a scheduler, and for its first worker
WORKER_DEATHS = 1  # of a log that is tried once more; the next death sets it aside


class ClusterLostError(RoverflowError):
    """The scheduler is gone; what has ended is in the catalogue."""

    exit_code = INCOMPLETE


@dataclass
class Fleet:
    """What a fleet runs. stall_seconds: without a new frame, after which a log counts as hung."""

    catalogue: Catalogue
    tasks: dict[str, Task]
    progress: Progress
    stall_seconds: float = 600.0
    left: set[str] = field(default_factory=set)
    _again: set[str] = field(default_factory=set)  # whose workers died
    _seen: dict[str, tuple[int, float]] = field(default_factory=dict)  # name -> frames and when they were new

    def run(self, client: Any) -> None:
        """Run all tasks, the largest first; raises ClusterLostError where the scheduler is gone."""
        from distributed import as_completed

        self._check(client)
        self.catalogue.put_all({name: _waiting(task) for name, task in self.tasks.items()})
        self.left = set(self.tasks)
        futures = {self._submit(client, name, place): name for place, name in enumerate(self.tasks)}
        ended, looked, stop = as_completed(futures), 0.0, Stop()
        with interrupts(stop, lambda sentence: None):  # an exception of the handler is lost in a destructor
            while self.left:
                try:
                    for future in ended.next_batch(block=False):
                        name = futures.pop(future)
                        if name in self.left and (again := self._end(client, name, future)):
                            futures[again] = name
                            ended.add(again)
                    if time.monotonic() > looked + POLL_SECONDS:
                        self._watch(client, futures)
                        looked = time.monotonic()
                except (OSError, TimeoutError, RuntimeError) as error:
                    remedy = "run the same command again to continue"
                    raise ClusterLostError(f"the cluster does not answer: {error}; {remedy}") from error
                if client.status != "running":
                    raise ClusterLostError("the scheduler is gone; run the same command again to continue")
                if stop.finishing():
                    raise KeyboardInterrupt
                if self.left:
                    time.sleep(POLL_SECONDS / 5)

    def _submit(self, client: Any, name: str, place: int) -> Any:
        """The future of a task; the smallest place runs first."""
        task = self.tasks[name]
        with suppress(OSError):  # of a worker that died
            if is_progress(task.progress):
                task.progress.unlink()
        self._seen.pop(name, None)
        key = f"roverflow-{task.job.digest}-{time.time_ns()}"
        return client.submit(run_task, task, key=key, priority=-place, pure=False)

    def _check(self, client: Any) -> None:
        """Refuse workers of another version, pipeline or machine, and those that do not see the logs or the stages."""
        task = next(iter(self.tasks.values()))
        with suppress(TimeoutError):
            client.wait_for_workers(1, timeout=CLUSTER_SECONDS)
        found = client.run(about_worker, task)
        if not found:
            raise UsageError("the cluster has no workers; start some")
        expected = about_worker(task)
        for worker, about in found.items():
            for name, here in expected.items():
                if about[name] != here:
                    differ = f"another {name} ({about[name]}) than this machine ({here})"
                    raise UsageError(f"the worker {worker} has {differ}")
        for worker, why in client.run(unfit, task).items():
            if why:
                raise UsageError(f"the worker {worker} {why}")

    def _end(self, client: Any, name: str, future: Any) -> Any:
        """Write the row of a task that has ended; or return its next future, if its workers died for the first time."""
        if future.status == "finished":
            row = _ended(self.tasks[name], future.result())
        elif future.status != "error":  # the scheduler forgot it
            raise ClusterLostError("the scheduler lost its tasks; run the same command again to continue")
        elif type(error := future.exception()).__name__ != "KilledWorker":
            row = {"state": "failed", "why": f"{type(error).__name__}: {error}"}
        elif name in self._again:
            row = {"state": "killed", "why": "its workers died: out of memory, or a machine fault"}
        else:
            self._again.add(name)
            self.progress.say(f"{name}: its workers died; it will run once more after the others")
            return self._submit(client, name, len(self.tasks))
        self._note(name, row)
        return None

    def _note(self, name: str, row: dict[str, Any]) -> None:
        """Write a row for good, and say what is left."""
        self.left.discard(name)
        self.catalogue.put(name, row | {"ended": datetime.now(UTC).isoformat(timespec="seconds")})
        self.progress.end(name, row)

    def _watch(self, client: Any, futures: dict[Any, str]) -> None:
        """Note which tasks run, and set aside those without progress."""
        now, running = time.monotonic(), dict[str, int]()
        begun = set[str]()
        for future, name in [item for item in futures.items() if item[1] in self.left]:
            frames = frames_so_far(self.tasks[name].progress)
            if frames is None:
                continue
            running[name] = frames
            seen = self._seen.get(name)
            if seen is None:
                begun.add(name)
            if seen is None or seen[0] != frames:
                self._seen[name] = (frames, now)
            elif now - seen[1] > self.stall_seconds:
                self._set_aside(client, name, future, frames)
        self.catalogue.put_all({name: {"state": "running"} for name in begun & self.left})
        self.progress.show(running)

    def _set_aside(self, client: Any, name: str, future: Any, frames: int) -> None:
        """Restart the worker of a task without progress; one that waits for a worker again is left."""
        holders = [worker for worker, keys in client.processing().items() if future.key in map(str, keys)]
        with suppress(OSError):
            self.tasks[name].progress.unlink()
        if not holders:
            self._seen.pop(name, None)
            return
        future.cancel(force=True)
        with suppress(Exception):  # the worker may die on its own
            client.restart_workers(holders, timeout=30, raise_for_error=False)
        self._clear(self.tasks[name])
        why = f"no frame in {self.stall_seconds:g} s, after frame {frames}"
        self._note(name, {"state": "hung", "why": why})

    def _clear(self, task: Task) -> None:
        """Remove what a log that hung has left; it is not run again."""
        with suppress(OSError):
            remove_checkpoint((task.result, task.result.with_suffix(".rrd")))
        remove_unfinished(task)


def _waiting(task: Task) -> dict[str, Any]:
    """The row of a log that waits."""
    row = WAITING | task.identity()
    return row | {"log": as_text(task.job.log), "bytes": task.job.size, "pipeline": task.pipeline.label}


def _ended(task: Task, row: Mapping[str, Any]) -> dict[str, Any]:
    """The row of a task as a worker returned it, with the path of the result in the fleet's folder."""
    if any(row[name] != value for name, value in task.identity().items()):  # a worker that came later
        return {"state": "failed", "why": f"{row['node']} has another version of roverflow or of the pipeline"}
    result = {"result": task.result.relative_to(task.folder).as_posix()} if row.get("result") else {}
    return {**row, **result}


@contextmanager
def cluster(address: str | None, processes: int, cores: int, memory: str, dashboard: bool) -> Iterator[Any]:
    """A client of the Dask cluster at `address`, or of worker processes of this machine that end with it.

    cores: of each process, to which it is bound. Raises UsageError if the extra `fleet` is missing, or nothing answers
    at the address.
    """
    try:
        import dask
        from distributed import Client, LocalCluster

        from flow.cli.fleet.binding import CoreBinding
    except ImportError as error:
        raise UsageError(f"a fleet needs dask.distributed; {remedy_for('distributed')}") from error
    for name in [name for name in logging.root.manager.loggerDict if name.startswith("distributed")]:
        logging.getLogger(name).setLevel(logging.CRITICAL)  # each has a level of its own
    dask.config.set(
        {
            "distributed.scheduler.allowed-failures": WORKER_DEATHS,
            "distributed.scheduler.default-task-durations": {"roverflow": "30m"},
            "distributed.scheduler.worker-saturation": 1.0,  # no log waits at a worker that may die
            # Dask's 64 kB returns the memory of every image to the system, and a run takes twice as long.
            "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 1 << 30,
            "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 32 << 20,
            "distributed.worker.memory.target": False, "distributed.worker.memory.spill": False,
            "distributed.worker.memory.pause": False,
        }
    )  # fmt: skip
    if address is not None:
        try:
            client = Client(address, timeout=CLUSTER_SECONDS)
        except (OSError, TimeoutError, ValueError, TypeError) as error:  # a type: no certificates for TLS
            raise UsageError(f"no Dask scheduler answers at {address}: {error}") from error
        with client:
            yield client
        return
    # An interrupted worker leaves semaphores behind, and multiprocessing would warn of them.
    os.environ.setdefault("PYTHONWARNINGS", "ignore:resource_tracker")
    settings = {"n_workers": processes, "threads_per_worker": 1, "processes": True, "memory_limit": memory}
    shown = {"dashboard_address": f"127.0.0.1:{8787 if dashboard else 0}", "scheduler_kwargs": {"dashboard": dashboard}}
    try:
        local = LocalCluster(**settings, **shown, host="127.0.0.1", silence_logs=logging.ERROR)
    except ValueError as error:
        raise UsageError(f"the worker processes cannot start: {error}") from error
    with local, Client(local) as client:
        client.register_plugin(CoreBinding(processes, cores))
        yield client
