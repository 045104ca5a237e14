"""Maps against the exact truth of simulated traverses: `rover` and `paper`, and `rover` given true disparity and tilt.

Run as `python -m tests.bench.terrain [--seeds 11 12 13] [--rocks 0.05 0.15] [--frames 30] [--stride 1] [--size WxH]
[--camera BASELINE HEIGHT DEG] [--json FILE]`; a stride of 10 makes a short form. Ground of 5 degrees RMS over 1 m, that
is slopes to 15 degrees and a few beyond; inclinometer noise 0.3 degrees; everything else is the simulator's default.
Each frame goes through the stages as the pipelines set them, one after the other on one core. Whether stated sigmas
with the tilt's hold is counted for every frame with the tilt errors of all frames, and of three times as many between:
what they are off by, a frame's cells are off by together.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from flow.align import Token
from flow.cli import arguments
from flow.malloc import keep_freed_memory
from recordings.scoring.table import ROWS, terrain_figures, terrain_lines
from recordings.scoring.terrain_metrics import TerrainTally, TrueGround
from recordings.simulator import ground_truth, traverse
from recordings.simulator.scenes import SCENES
from recordings.simulator.simulation import TILT_RATE, FrameTruth, Simulation
from recordings.source.tilt_noise import WINDOW, TiltNoise
from stages.data import Array, Cell, Disparity, Mount, PixelOrigin, StereoFrame, Tilt, Transform
from tests.bench.refining import graph_of, stage

SLOPE, TILT_NOISE = np.radians(5.0), np.radians(0.3)
RUNS = {name: name for name in ("rover", "fast", "accurate", "paper")} | {"rover, true disparity and tilt": "rover"}
DEFAULT_RUNS = ("rover", "paper", "true")
TILT_SAMPLES = 10  # after a frame, from which a pipeline takes what it smooths over
TERRAIN_STREAMS = ("cloud", "cleaned", "points", "cells", "elevation_map", "navigation_map")


class TiltedTally(TerrainTally):
    """Tests the stated sigmas with many errors of the tilt.

    A frame has one error of the tilt, which all of its cells share, so few frames cannot test sigmas that contain it.
    tilts: (N, 2) such errors, as slopes along x and y.
    """

    tilts: Array = np.zeros((1, 2))

    def add_total(self, truth: TrueGround, error: Array, variance: Array) -> None:
        for east, north in self.tilts:
            super().add_total(truth, error + east * truth.x[None, :] + north * truth.y[:, None], variance)


@dataclass
class Run:
    """What one pipeline made of some frames."""

    tally: TiltedTally = field(default_factory=TiltedTally)
    seconds: list[float] = field(default_factory=list)


def frames(simulation: Simulation, stride: int) -> Iterator[tuple[dict[str, Any], dict[str, Any], TrueGround]]:
    """A frame's inputs of the pipelines except its tilt, the true values of the same streams, and its true map."""
    left, _, inclinometer = simulation.mounts
    camera_from_inclinometer = left.rotation.T @ inclinometer.rotation
    for index in range(0, simulation.frames, stride):
        stamp, truth = simulation.stamp(index), simulation.frame(index)
        base_from_camera = Transform("base_link", simulation.camera.frame_id, left.rotation, left.translation)
        given = {
            "stereo": StereoFrame(stamp, *truth.images, simulation.camera),
            "mounting": Mount(stamp, camera_from_inclinometer, base_from_camera),
        }
        up = (truth.base.rotation @ inclinometer.rotation)[2]
        exact = {"disparity": seen_by_both(simulation, stamp, truth), "tilt": Tilt(stamp, up / np.linalg.norm(up))}
        elevation, hazards = ground_truth.truth_maps(simulation, stamp, truth)
        rocks = ground_truth.rocks_in_level(simulation, truth)[:, [0, 1, 3, 4, 5, 6]]
        ground = TrueGround.of(elevation, hazards.cells == Cell.HAZARD, rocks)
        yield given, exact, ground


def measured_tilt(pipeline: str, simulation: Simulation, stamp: int) -> Tilt:
    """The tilt as the pipeline's own aligner makes it of the inclinometer's samples about a frame."""
    number = int((stamp - simulation.begin) * 1e-9 * TILT_RATE)
    aligner = stage(pipeline, "tilt")
    state, noise = aligner.start("tilt", {"stream": "inclinometer"}), TiltNoise()
    for sample in range(max(number - WINDOW, 0), number + TILT_SAMPLES + 1):
        at = simulation.begin + round(sample / TILT_RATE * 1e9)
        state.samples.append(Token(at, noise(Tilt(at, measured_up(simulation, sample, at)))))
    tilt = aligner.choose(state, stamp, " by the log's end")
    assert isinstance(tilt, Tilt), tilt
    return tilt


@cache
def measured_up(simulation: Simulation, sample: int, at: int) -> Array:
    """A sample of the inclinometer, (3,)."""
    random = np.random.default_rng([simulation.seed, 4, sample])
    base, mount = simulation.base_at(at), simulation.mounts[2]
    reading = traverse.inclinometer_reading(base, mount, simulation.tilt_noise, random)
    up = Rotation.from_quat(reading).as_matrix()[2]
    return np.asarray(up / np.linalg.norm(up))


def tilt_errors(pipeline: str, simulation: Simulation) -> Array:
    """By how much the pipeline's tilt is off, (N, 2): slopes along x and y that it gives to level ground, at each frame
    of the traverse and three times between."""
    return np.array([tilt_error(simulation, tilt) for tilt in measured_tilts(pipeline, simulation)])


def measured_tilts(pipeline: str, simulation: Simulation) -> list[Tilt]:
    """The pipeline's tilts at those times."""
    times = simulation.start + np.arange(4 * simulation.frames) * round(0.25e9 / simulation.rate)
    offset = simulation.stamp(0) - simulation.start
    return [measured_tilt(pipeline, simulation, int(at) + offset) for at in times]


def tilt_error(simulation: Simulation, tilt: Tilt) -> Array:
    """The same (2,) for one tilt."""
    base = simulation.base_at(tilt.stamp)
    level = traverse.level_pose(base)
    up = level.rotation.T @ base.rotation @ simulation.mounts[2].rotation @ tilt.up
    return np.asarray(up[:2] / up[2])


def seen_by_both(simulation: Simulation, stamp: int, truth: FrameTruth) -> Disparity:
    """The true disparity of the pixels that both cameras see, as if measured without error."""
    true = ground_truth.true_disparity(simulation, stamp, truth)
    known = truth.seen == 255
    source = np.where(known, np.uint8(PixelOrigin.MEASURED), np.uint8(PixelOrigin.UNKNOWN))
    pixels = np.where(known, true.pixels, np.float32(np.nan))
    return Disparity(stamp, pixels, source, known.astype(np.float32), camera=simulation.camera)


def through(pipeline: str, streams: dict[str, Any]) -> tuple[dict[str, Any], float]:
    """The further streams up to a frame's navigation map, and the processor seconds of terrain stages."""
    steps, streams, seconds = graph_of(pipeline).upstream_of(["navigation_map"], streams), dict(streams), 0.0
    for node in steps.nodes:
        start = time.thread_time()
        streams[node.name] = node.actor(**{port: streams[stream] for port, stream in node.inputs.items()})
        seconds += (time.thread_time() - start) * (node.name in TERRAIN_STREAMS)
    return streams, seconds


def score(simulations: Sequence[Simulation], stride: int, runs: dict[str, str]) -> dict[str, Run]:
    """Each run over the frames of all simulations."""
    found = {name: Run() for name in runs}
    others = {
        pipeline: np.concatenate([tilt_errors(pipeline, simulation) for simulation in simulations])
        for pipeline in dict.fromkeys(runs.values())
    }
    for pipeline, errors in others.items():
        off = np.degrees(np.arctan(np.sqrt(np.mean(errors**2, axis=0))))
        print(
            f"tilt of {pipeline}: off by {off[0]:.3f} and {off[1]:.3f} degrees (RMS, {len(errors)} tilts)", flush=True
        )
    for simulation in simulations:
        for given, exact, ground in frames(simulation, stride):
            for name, pipeline in runs.items():
                tilt = measured_tilt(pipeline, simulation, given["stereo"].stamp)
                exact["tilt"] = replace(exact["tilt"], sigma=tilt.sigma)
                streams, seconds = through(pipeline, given | (exact if "true" in name else {"tilt": tilt}))
                layers: dict[str, Array] = dict(streams["elevation_map"].layers)
                found[name].tally.tilts = others[pipeline] - tilt_error(simulation, streams["tilt"])
                found[name].tally.add(ground, layers, streams["navigation_map"].cells)
                found[name].seconds.append(seconds)
    return found


def figures(run: Run) -> list[str]:
    """The table's column of one run."""
    return [*terrain_figures(run.tally.metrics()), f"{1e3 * float(np.median(run.seconds)):.0f}"]


def main(given: Sequence[str] | None = None) -> None:
    """Print the table for each abundance of rocks."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.terrain", description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[11, 12, 13])
    parser.add_argument("--rocks", type=float, nargs="+", default=[0.05, 0.15], help="k of Golombek's law")
    parser.add_argument("--frames", type=int, default=30, help="frames of each traverse")
    parser.add_argument("--stride", type=int, default=1, help="score every n-th frame")
    camera = "distance between the cameras and their height, m, and how far they look down"
    names, default = ("BASELINE", "HEIGHT", "DEG"), (0.24, 0.9, 15.0)
    parser.add_argument("--camera", type=float, nargs=3, default=default, metavar=names, help=camera)
    parser.add_argument("--scenes", choices=SCENES, nargs="+", default=["gravel", "mixed"], help="looks of the ground")
    parser.add_argument("--size", type=arguments.size, default=(1280, 960), metavar="WxH", help="of the images")
    parser.add_argument("--runs", nargs="+", choices=[*RUNS, "true"], default=DEFAULT_RUNS)
    parser.add_argument("--rings", action="store_true", help="also the score by distance")
    parser.add_argument("--json", type=Path, help="all metrics into this file")
    options = parser.parse_args(given)
    cv2.setNumThreads(1)
    keep_freed_memory()  # as a run does
    runs = {name: RUNS[name] for name in RUNS if name in options.runs or ("true" in options.runs and "true" in name)}
    (width, height), (baseline, above, down) = options.size, options.camera
    everything = {}
    for rocks, scene in product(options.rocks, options.scenes):
        simulations = [
            Simulation(scene=scene, frames=options.frames, seed=seed, abundance=rocks, slope=float(SLOPE),
                       threads=1, tilt_noise=float(TILT_NOISE), width=width, height=height, baseline=baseline,
                       camera_height=above, pitch_down=float(np.radians(down))) for seed in options.seeds
        ]  # fmt: skip
        found = score(simulations, options.stride, runs)
        count = len(next(iter(found.values())).seconds)
        ground = f"scene {scene}, rocks k = {rocks}"
        print(f"\n{ground}, {count} frames of {width}x{height}, seeds {', '.join(map(str, options.seeds))}")
        columns = [[*ROWS, "disparity to navigation map, ms on one core"], *(figures(run) for run in found.values())]
        print(f"{'':66}" + "".join(f"{name.split(',')[-1].strip():>26}" for name in found))
        for label, *cells in zip(*columns, strict=True):
            print(f"{label:66}" + "".join(f"{cell:>26}" for cell in cells), flush=True)
        if options.rings:
            for name, run in found.items():
                print("\n".join(["", name, *terrain_lines(run.tally.metrics())]))
        everything[f"{scene}, {rocks}"] = {name: run.tally.metrics() for name, run in found.items()}
    if options.json is not None:
        options.json.write_text(json.dumps(everything, indent=2))


if __name__ == "__main__":
    main()
