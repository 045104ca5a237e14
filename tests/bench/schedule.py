"""The schedule of a campaign on many workers: hours, and the share of their time that is used.

Durations are drawn from those of a fleet's catalogue and scaled to a mean. A run fails with a probability, at a random
part of its time, and is repeated. Each start costs the overhead of a log.
"""

from __future__ import annotations

import argparse
import heapq
from pathlib import Path

import numpy as np

from flow.cli.fleet.catalogue import Catalogue
from stages.data import Array


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser("python -m tests.bench.schedule", description=__doc__)
    parser.add_argument("folder", type=Path, help="folder of a fleet, for its durations")
    parser.add_argument("--minutes", type=float, default=10.0, help="mean duration of a log (10)")
    parser.add_argument("--failures", type=float, default=0.01, help="share of runs whose worker dies (0.01)")
    parser.add_argument("--overhead", type=float, default=0.5, help="seconds beside each run (0.5)")
    options = parser.parse_args()
    known = np.array([row["seconds"] for row in Catalogue(options.folder).rows("state = 'done'")])
    random = np.random.default_rng(1)
    print(f"{'workers':>8} {'logs':>8} {'order':>14} {'hours':>9} {'busy':>6}")
    for logs in (100, 1000, 100_000):
        drawn = random.choice(known, logs) * random.lognormal(0, 0.3, logs)
        seconds = drawn * 60 * options.minutes / drawn.mean()
        for workers in (10, 100, 1000):
            for order, queue in (("as they come", seconds), ("longest first", np.sort(seconds)[::-1])):
                end = schedule(queue + options.overhead, workers, options.failures, random)
                busy = seconds.sum() / (end * workers)
                print(f"{workers:>8} {logs:>8} {order:>14} {end / 3600:>9.2f} {busy:>6.2f}")


def schedule(seconds: Array, workers: int, failures: float, random: np.random.Generator) -> float:
    """The time at which the last log ends; seconds: of each log, in their order."""
    free = [0.0] * workers
    lost = np.where(random.random(len(seconds)) < failures, random.random(len(seconds)), 0.0)
    for duration in seconds * (1 + lost):
        heapq.heapreplace(free, free[0] + duration)
    return max(free)


if __name__ == "__main__":
    main()
