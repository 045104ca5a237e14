"""How long commands take to their first answer, imports and survey included: wall and CPU time of the whole process.

Run as `python -m tests.bench.start [--log LOG] [--repeats 3]`; by default it simulates a log of 1280x960. Kernels are
compiled before. Medians; `why` answers with its first line, the others with the file that they write.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from recordings.simulator import Simulation, write_log
from tests.bench.pipeline import cpu_of_children

FRAMES, AT = 12, 2.5  # AT: an instant of the log, s
CHANGE = "disparity.superpixels=2000"


def main(arguments: list[str] | None = None) -> None:
    """Print a table."""
    parser = argparse.ArgumentParser("python -m tests.bench.start", description=__doc__)
    parser.add_argument("--log", type=Path, help="log with a frame at 2.5 s")
    parser.add_argument("--repeats", type=int, default=3, help="runs of each command (3)")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = options.log or folder / "log.mcap"
        if options.log is None:
            write_log(Simulation(frames=FRAMES, width=1280, height=960), log)
        frame = ["--start", AT - 0.25, "--end", AT + 0.25]  # at 2 Hz
        out, picture = folder / "out.mcap", folder / "try.rrd"
        commands = {
            "run, one frame": (["run", log, *frame, "-o", out, "--no-rrd"], "wrote"),
            "the same with a recording": (["run", log, *frame, "-o", out], "wrote"),
            "why": (["why", out, "--at", AT, "--cell", "3,0", "--log", log], "cell"),
            "try, its first picture": (["try", log, "--at", AT, "--set", CHANGE, "--out", picture], "wrote"),
        }
        print(f"{'time to the answer':<28}{'wall s':>8}{'CPU s':>8}")
        for title, (words, answer) in commands.items():
            _answered(words, answer)  # compiles what is not compiled yet
            wall, cpu = np.median([_answered(words, answer) for _ in range(options.repeats)], axis=0)
            print(f"{title:<28}{wall:>8.2f}{cpu:>8.2f}")


def _answered(words: list[object], answer: str) -> tuple[float, float]:
    """Seconds until a command prints a line with `answer`, and the CPU time of the whole command, s."""
    begun, before = time.perf_counter(), cpu_of_children()
    command = [sys.executable, "-m", "flow", *map(str, words)]
    environment = os.environ | {"PYTHONUNBUFFERED": "1"}
    answered = None
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if answered is None and answer in line.decode():
                answered = time.perf_counter() - begun
    if answered is None:
        raise RuntimeError(f"{command} printed no line with '{answer}'")
    return answered, cpu_of_children() - before


if __name__ == "__main__":
    main()
