"""The whole pipeline on simulated traverses: frames/s, ms per stage, how busy the cores are, peak memory.

Every run is a process of its own, started from the command line as a user would, so that peak memory is that of the
product alone. Compiled kernels come from the cache, which a first short run fills.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

SIZES = {"1280x960": 192, "640x480": 96}
FRAMES = 30


def main() -> None:
    """Print one table per pipeline and image size."""
    cores = len(os.sched_getaffinity(0))
    print(f"replaying {FRAMES} simulated frames on {cores} cores, result log and recording written")
    with tempfile.TemporaryDirectory() as folder:
        for size, disparities in SIZES.items():
            log = Path(folder) / f"{size}.mcap"
            _roverflow("simulate", log, "--scene", "gravel", "--frames", FRAMES, "--size", size)
            for pipeline in ("rover", "fast", "accurate", "paper"):
                _bench(log, pipeline, size, disparities, cores)


def _bench(log: Path, pipeline: str, size: str, disparities: int, cores: int) -> None:
    arguments = ("run", log, "-p", pipeline, "--set", f"disparities={disparities}", "--workers", cores)
    out, summary_file = log.with_name("out.mcap"), log.with_name("summary.json")
    _roverflow(*arguments, "-o", out, "--end", 0.6)
    _roverflow(*arguments, "-o", out, "--summary", summary_file)
    summary = json.loads(summary_file.read_text())
    busy = summary["cpu_seconds"] / summary["wall_seconds"]
    print(
        f"\n{pipeline} {size}, {disparities} disparities: {summary['frames_per_second']:.2f} frames/s, "
        f"{busy:.2f} of {cores} cores busy, {summary['start_seconds']:.1f} s before the first frame, "
        f"peak memory {summary['peak_memory_mb']:.0f} MB"
    )
    for stage, seconds in summary["seconds"].items():
        print(f"  {stage:24} {1000 * seconds / summary['frames_out']:8.1f} ms/frame")


def _roverflow(*arguments: object) -> None:
    subprocess.run([sys.executable, "-m", "flow", *map(str, arguments)], check=True, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    main()
