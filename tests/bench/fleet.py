"""A fleet of logs of different length: two worker processes beside one, the overhead of a log, the share of stages.

Fleets of one process, two processes, and one process with a third of the logs alternate; figures are of the fastest of
each. A fleet's time is that of starting, of its runs, and of an overhead for each log. So two fleets of one process
with different numbers of logs give the overhead and the time of starting. Two commands `roverflow run` at once, over
the same two one after the other, show what the machine itself gains by a second process.

With --tiny, a scheduler, two workers and a client, each a process of its own, run that many logs of one and two frames
instead; the table has the memory of each process and the CPU of scheduler and client, as logs end.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import psutil
from distributed import Client

from flow.cli.fleet.catalogue import NAME, Catalogue
from recordings.simulator import Simulation, write_log
from tests.bench.pipeline import roverflow

LOGS, FEW = 12, 4
DIFFERENT, PORT = 20, 18790  # tiny logs that differ; of the scheduler
SETTINGS = ("-p", "rover", "--set", "disparities=96", "--workers-per-log", "1")


@dataclass(frozen=True)
class Fleet:
    """Seconds of a whole fleet, of its runs, of their CPU, and of the CPU of their stages, surveys and sinks."""

    seconds: float
    runs: float
    cpu: float
    stages: float


def main(arguments: list[str] | None = None) -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser("python -m tests.bench.fleet", description=__doc__)
    parser.add_argument("--rounds", type=int, default=2, help="fleets of each kind (2)")
    catalogue = "folder that gets the catalogue of one process, for tests.bench.schedule"
    parser.add_argument("--catalogue", type=Path, metavar="DIR", help=catalogue)
    parser.add_argument("--tiny", type=int, metavar="LOGS", help="memory of the processes with that many tiny logs")
    options = parser.parse_args(arguments)
    if options.tiny:
        _tiny(options.tiny)
        return
    rounds, keep = options.rounds, options.catalogue
    with tempfile.TemporaryDirectory() as folder:
        logs = Path(folder) / "logs"
        logs.mkdir()
        for number in range(LOGS):
            simulation = Simulation(frames=6 + 4 * number, width=640, height=480, seed=number)
            write_log(simulation, logs / f"log{number:02d}.mcap")
        every, few = sorted(logs.iterdir()), sorted(logs.iterdir())[:FEW]
        _fleet(few, Path(folder) / "warm", 1)  # fills the cache of kernels
        kinds = {"one": (every, 1), "two": (every, 2), "few": (few, 1)}
        found: dict[str, list[Fleet]] = {name: [] for name in kinds}
        for turn in range(rounds):
            for name, (chosen, processes) in kinds.items():
                found[name].append(_fleet(chosen, Path(folder) / f"{name}{turn}", processes))
        if keep:
            keep.mkdir(parents=True, exist_ok=True)
            shutil.copy(Path(folder) / "one0" / NAME, keep)
        gain = min(_at_once(every[-1], Path(folder) / f"plain{turn}") for turn in range(rounds))
    _print(*(min(fleets, key=lambda fleet: fleet.seconds) for fleets in found.values()), gain)


def _print(one: Fleet, two: Fleet, few: Fleet, gain: float) -> None:
    beside = {fleet: fleet.seconds - fleet.runs for fleet in (one, few)}
    overhead = (beside[one] - beside[few]) / (LOGS - FEW)
    print(f"\nfleet of {LOGS} logs of 6 to {6 + 4 * (LOGS - 1)} frames, 640x480, rover, one thread a log")
    for name, value in {
        "one process, s": one.seconds,
        "CPU of its runs, s": one.cpu,
        "two processes, s": two.seconds,
        "CPU of their runs, s": two.cpu,
        "two processes over one": two.seconds / one.seconds,
        "two plain runs at once over one after the other": gain,
        "starting and ending a fleet, s": beside[one] - LOGS * overhead,
        "overhead of a log beside its run, s": overhead,
        "CPU of stages, surveys and sinks over a worker's time": one.stages / (one.runs + LOGS * overhead),
    }.items():
        print(f"  {name:48} {value:9.3f}")


def _at_once(log: Path, out: Path) -> float:
    """Time of two commands `roverflow run` at once, over that of two one after the other."""
    out.mkdir()
    words = (sys.executable, "-m", "flow", "run", str(log), "-p", "rover", "--set", "disparities=96", "--workers", "1")
    times = []
    for number, waits in enumerate((True, False)):
        begun = time.perf_counter()
        running = []
        for name in ("a", "b"):
            result = str(out / f"{name}{number}.mcap")
            running.append(subprocess.Popen([*words, "--no-rrd", "-o", result], stdout=subprocess.DEVNULL))
            if waits:
                running[-1].wait()
        if any(process.wait() for process in running):
            raise RuntimeError("roverflow run failed")
        times.append(time.perf_counter() - begun)
    return times[1] / times[0]


def _fleet(logs: list[Path], out: Path, processes: int) -> Fleet:
    """Run the logs, and read the catalogue."""
    seconds = roverflow("fleet", *logs, "--out", out, *SETTINGS, "--processes", processes)
    rows = Catalogue(out).rows()
    return Fleet(seconds, *(sum(row[name] for row in rows) for name in ("seconds", "cpu_seconds", "stage_seconds")))


def _tiny(logs: int) -> None:
    """Print the memory of all processes after a tenth, half and all of the logs."""
    with tempfile.TemporaryDirectory() as name:
        folder, address = Path(name), f"tcp://127.0.0.1:{PORT}"
        (folder / "logs").mkdir()
        for number in range(min(DIFFERENT, logs)):
            simulation = Simulation(frames=1 + number % 2, width=64, height=64, seed=number, relief_cells=512)
            write_log(simulation, folder / f"log{number}.mcap")
        for number in range(logs):
            (folder / "logs" / f"log{number:05d}.mcap").symlink_to(folder / f"log{number % DIFFERENT}.mcap")
        scheduler = ("scheduler", "--host", "127.0.0.1", "--port", str(PORT), "--no-dashboard")
        worker = ("worker", address, "--nthreads", "1", "--host", "127.0.0.1", "--no-dashboard", "--no-nanny")
        dask = [
            subprocess.Popen([sys.executable, "-m", f"distributed.cli.dask_{kind}", *words], stderr=subprocess.DEVNULL)
            for kind, *words in (scheduler, worker, worker)
        ]
        try:
            with Client(address, timeout=60) as client:
                client.wait_for_workers(2, timeout=60)
            _watch_memory(folder, logs, address, dask)
        finally:
            for process in reversed(dask):
                process.terminate()
                process.wait()


def _watch_memory(folder: Path, logs: int, address: str, dask: list[subprocess.Popen[bytes]]) -> None:
    words = ["fleet", str(folder / "logs"), "--out", str(folder / "out"), "-p", "fast", "--set", "disparities=16"]
    command = [sys.executable, "-m", "flow", *words, "--workers-per-log", "1", "--cluster", address]
    print(f"\n{logs} logs of 1 and 2 frames, 64x64, fast, one thread a log; client, scheduler, two workers")
    print(f"{'logs':>8} {'memory, MB':>24} {'CPU of client and scheduler, s':>32}")
    begun = time.perf_counter()
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as fleet:
        watched = [psutil.Process(process) for process in (fleet.pid, *(process.pid for process in dask))]
        assert fleet.stdout is not None
        for line in fleet.stdout:
            ended = line.partition(" of ")[0]
            if ended in {str(logs // 10), str(logs // 2), str(logs)}:
                memory = " ".join(f"{process.memory_info().rss / 1e6:.0f}" for process in watched)
                cpu = " ".join(f"{sum(process.cpu_times()[:2]):.1f}" for process in watched[:2])
                print(f"{ended:>8} {memory:>24} {cpu:>32}")
    rows = Catalogue(folder / "out").rows("state = 'done' AND verdict = 'COMPLETE'")
    print(f"{time.perf_counter() - begun:.0f} s; {len(rows)} of {logs} logs in the catalogue are COMPLETE")


if __name__ == "__main__":
    main()
