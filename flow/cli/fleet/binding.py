"""Binds worker processes of this machine to the cores assigned to them, as a batch system does."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from distributed import WorkerPlugin


@dataclass(frozen=True)
class CoreBinding(WorkerPlugin):
    """The cores of each of `processes` workers; without a system call for it, or with too few cores, all of them."""

    processes: int
    cores: int
    name = "cores"

    def setup(self, worker: Any) -> None:
        """Bind a worker that has started, also one that follows a dead one; its name is its place."""
        if not hasattr(os, "sched_setaffinity"):
            return
        allowed = sorted(os.sched_getaffinity(0))
        if self.processes * self.cores <= len(allowed):
            mine = allowed[worker.name * self.cores :][: self.cores]
            for thread in Path("/proc/self/task").iterdir():  # each is bound alone; later ones inherit it
                os.sched_setaffinity(int(thread.name), mine)
