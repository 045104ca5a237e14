"""The price of a frame, from log to result log and recording, beside one match by OpenCV.

Every run is a process of its own, started from the command line as a user would. A frame's CPU time is that of a long
run less that of a short one, over the frames between them: so it has no share in starting, which is printed by itself,
nor in what the first judgement of the tilt imports.
OpenCV matches between the runs, on one thread, because the speed of a machine changes within minutes. Figures are
medians of the rounds. Compiled kernels come from the cache, which a first short run fills.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from statistics import median
from typing import Any

import cv2

from recordings.source.mcap_source import McapSource
from stages.data import CameraImage
from stages.matching.intensity import gray

SIZES = {"1280x960": 192, "640x480": 96, "240x180": 48}
PIPELINES = {"1280x960": ("rover", "fast", "accurate", "paper"), "640x480": ("rover", "fast"), "240x180": ("rover",)}
SHORT, LONG, ROUNDS = 16, 46, 3
PAPER = (2, 8, 1)  # of `paper`, which takes 50 times as long as `fast`
TO_POINTS = ("cloud", "cleaned", "points", "cells")  # Reproject, Clean, Level, Voxelise
BEFORE = ("rectified", "disparity")  # the stages up to the disparity
SINKS = ("recordings.McapSink", "recordings.RerunSink")


def main(arguments: list[str] | None = None) -> None:
    """Print a table for each image size and pipeline."""
    parser = argparse.ArgumentParser("python -m tests.bench.pipeline", description=__doc__)
    parser.add_argument("--size", nargs="+", choices=SIZES, default=list(SIZES), help="sizes of the images (all)")
    parser.add_argument("--pipelines", nargs="+", choices=PIPELINES["1280x960"], help="pipelines (those of the size)")
    options = parser.parse_args(arguments)
    cores = len(os.sched_getaffinity(0))
    print(f"{LONG} simulated frames of scene mixed, {cores} workers, result log and recording written")
    with tempfile.TemporaryDirectory() as folder:
        for size in options.size:
            disparities = SIZES[size]
            log = Path(folder) / f"{size}.mcap"
            roverflow("simulate", log, "--frames", LONG, "--size", size)
            match = _opencv(log, disparities)
            for pipeline in options.pipelines or PIPELINES[size]:
                short, long, rounds = PAPER if pipeline == "paper" else (SHORT, LONG, ROUNDS)
                bench = [_round(log, pipeline, disparities, cores, (short, long), match) for _ in range(rounds + 1)]
                _print(f"{pipeline}, {size}, {disparities} disparities", bench[1:])  # the first one fills the cache


def _opencv(log: Path, disparities: int) -> Callable[[], float]:
    """A function that matches the log's first pair by MODE_HH on one thread and returns the CPU time, s."""
    pair: dict[str, Any] = {}
    with McapSource().open(log) as events:
        for _, stream, item in events.events(("left", "right")):
            if isinstance(item, CameraImage):
                pair.setdefault(stream, gray(item.pixels))
            if len(pair) == 2:
                break
    matcher = cv2.StereoSGBM.create(0, disparities, 5, 200, 800, 1, 0, 0, 0, 0, cv2.STEREO_SGBM_MODE_HH)

    def match() -> float:
        threads = cv2.getNumThreads()
        cv2.setNumThreads(1)
        begun = time.process_time()
        matcher.compute(pair["left"], pair["right"])
        cv2.setNumThreads(threads)
        return time.process_time() - begun

    return match


def _round(
    log: Path, pipeline: str, disparities: int, cores: int, lengths: tuple[int, int], match: Callable[[], float]
) -> dict[str, float]:
    """Figures of a short and a long run with matches by OpenCV before, between and after them."""
    out, file, reference, runs = log.with_name("out.mcap"), log.with_name("summary.json"), [match()], []
    for frames in lengths:
        arguments = ("-p", pipeline, "--set", f"disparities={disparities}", "--workers", cores, "--summary", file)
        before = cpu_of_children()
        roverflow("run", log, *arguments, "--end", _seconds(frames), "-o", out)
        runs.append({**json.loads(file.read_text()), "whole_cpu": cpu_of_children() - before})
        reference.append(match())
    (short, long), hh = runs, median(reference)
    frames = long["frames_through"] - short["frames_through"]
    cpu = long["whole_cpu"] - short["whole_cpu"]
    wall = long["wall_seconds"] - short["wall_seconds"] - long["start_seconds"] + short["start_seconds"]
    of = {name: (seconds - short["cpu_seconds_of"][name]) / frames for name, seconds in long["cpu_seconds_of"].items()}
    after = {name: seconds for name, seconds in of.items() if name.partition("/")[0] not in BEFORE}
    sizes = [path.stat().st_size for path in (out, out.with_suffix(".rrd"))]
    return {
        "OpenCV MODE_HH, s of CPU": hh,
        "frames/s": frames / wall,
        "CPU of a frame, ms": 1000 * cpu / frames,
        "CPU of a frame, over HH": cpu / frames / hh,
        "up to the disparity, over HH": (sum(of.values()) - sum(after.values())) / hh,
        "after the disparity with sinks, over HH": sum(after.values()) / hh,
        "McapSink, over HH": of[SINKS[0]] / hh,
        "RerunSink, over HH": of[SINKS[1]] / hh,
        "Reproject, Clean, Level, Voxelise, over HH": sum(of.get(name, 0) for name in TO_POINTS) / hh,
        f"wall time over CPU time / {cores}": wall * cores / cpu,
        "result log of a frame, MB": sizes[0] / long["frames_through"] / 1e6,
        "recording of a frame, MB": sizes[1] / long["frames_through"] / 1e6,
        "peak memory, MB": long["peak_memory_mb"],
        "CPU of starting, s": short["whole_cpu"] - cpu / frames * short["frames_through"],
    } | {f"  {name}, ms": 1000 * seconds for name, seconds in of.items()}


def _print(title: str, rounds: Iterable[dict[str, float]]) -> None:
    rounds = list(rounds)
    print(f"\n{title}")
    for name in rounds[0]:
        print(f"  {name:46} {median(figures[name] for figures in rounds):9.3f}")


def _seconds(frames: int) -> float:
    """The end of the part of a simulated log that has this many frames: two a second."""
    return frames / 2 + 0.3


def cpu_of_children() -> float:
    """CPU time, s, of the commands that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def roverflow(*arguments: object) -> float:
    """Run a command in a process of its own; its wall time, s."""
    begun = time.perf_counter()
    subprocess.run([sys.executable, "-m", "flow", *map(str, arguments)], check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - begun


if __name__ == "__main__":
    main()
