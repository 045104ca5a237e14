"""`roverflow simulate`: writes a synthetic traverse with exact ground truth."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import Any

from flow.cli.arguments import size
from flow.cli.outputs import check_outputs
from flow.cli.report import say
from flow.contracts import counted
from flow.errors import COMPLETE, UsageError

HELP = "write a synthetic traverse with ground truth topics under /truth"

# option -> (field of recordings.simulator.Simulation, its unit)
OPTIONS = {
    "frames": ("frames", 1),
    "seed": ("seed", 1),
    "baseline": ("baseline", 1),
    "camera_height": ("camera_height", 1),
    "pitch_down": ("pitch_down", math.radians(1)),
    "rocks": ("abundance", 1),
    "slope": ("slope", math.radians(1)),
    "tilt_noise": ("tilt_noise", math.radians(1)),
    "odometry_scale": ("odometry_scale", 0.01),
    "odometry_turn": ("odometry_turn", math.radians(1)),
}


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Declare the options."""
    sub.add_argument("out", type=Path, metavar="OUT.mcap")
    sub.add_argument("--frames", type=int, help="number of stereo frames (12)")
    sub.add_argument("--seed", type=int, help="random seed of terrain and noise (1)")
    sub.add_argument("--size", type=size, default=(1280, 960), metavar="WxH", help="image size (1280x960)")
    sub.add_argument("--baseline", type=float, metavar="M", help="distance between the cameras (0.24)")
    sub.add_argument("--camera-height", type=float, metavar="M", help="height of the cameras above the ground (0.9)")
    sub.add_argument("--pitch-down", type=float, metavar="DEG", help="angle of the cameras below the horizon (15)")
    sub.add_argument("--rocks", type=float, metavar="K", help="fraction of ground under rocks (Golombek's k, 0.1)")
    sub.add_argument("--slope", type=float, metavar="DEG", help="RMS slope of the terrain (4)")
    sub.add_argument("--tilt-noise", type=float, metavar="DEG", help="inclinometer noise, one sigma (0.1)")
    scale = "scale error of odometry (1); 0, with --odometry-turn 0, is exact"
    sub.add_argument("--odometry-scale", type=float, metavar="PERCENT", help=scale)
    turn = "heading drift of odometry after 1 m, one sigma; grows with the square root of the distance (0.2)"
    sub.add_argument("--odometry-turn", type=float, metavar="DEG", help=turn)


def run(options: argparse.Namespace) -> int:
    """Write the traverse."""
    check_outputs({"input log": options.out})
    given = {option: getattr(options, option) for option in OPTIONS}
    settings = {OPTIONS[o][0]: value * OPTIONS[o][1] for o, value in given.items() if value is not None}
    width, height = options.size
    try:
        simulate(options.out, **settings, width=width, height=height)
    except UsageError as error:
        raise UsageError(_with_options(str(error))) from None
    return COMPLETE


def _with_options(sentence: str) -> str:
    """The sentence about a field of Simulation, with the name of the option instead."""
    for option, (field, _) in OPTIONS.items():
        sentence = sentence.replace(f"Simulation.{field} ", f"--{option.replace('_', '-')} ")
    for side in ("width", "height"):
        sentence = sentence.replace(f"Simulation.{side} ", f"the {side} of --size ")
    return sentence


def simulate(out: Path, **settings: Any) -> None:
    """Write a simulated traverse; `settings` are fields of `recordings.simulator.Simulation`."""
    from tqdm import tqdm

    from recordings.simulator import Simulation, write_log

    try:
        simulation = Simulation(**settings)
    except ValueError as error:
        raise UsageError(str(error)) from None
    with tqdm(total=simulation.frames, unit="frame", disable=not sys.stderr.isatty()) as bar:

        def progress(done: int, total: int) -> None:
            bar.update(done - bar.n)

        write_log(simulation, out, progress)
    say(f"{out}: {counted(simulation.frames, 'frame')} with ground truth ({out.stat().st_size / 1e6:.1f} MB)")
