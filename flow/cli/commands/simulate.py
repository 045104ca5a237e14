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

UNITS = {"DEG": math.radians(1), "PERCENT": 0.01, "MS": 0.001}  # of values, in those of recordings.simulator.Simulation
TYPES: dict[str, type] = {"N": int, "QUALITY": int, "NAME": str, "KIND": str}  # of values; the others are float
FIELDS = {"rocks": "abundance"}  # option -> field of Simulation, where it has another name

# option -> (name of the value, help)
OPTIONS = {
    "scene": ("NAME", "defaults for gravel, mixed, dunes, dusk or bedrock (mixed)"),
    "frames": ("N", "number of stereo frames (12)"),
    "seed": ("N", "random seed of terrain and noise (1)"),
    "baseline": ("M", "distance between the cameras (0.24)"),
    "camera_height": ("M", "height of the cameras above the ground (0.9)"),
    "pitch_down": ("DEG", "angle of the cameras below the horizon (15)"),
    "rocks": ("K", "rock abundance, Golombek's k: share of ground under rocks (0.1; dunes: 0.015; bedrock: 0.05)"),
    "slope": ("DEG", "RMS slope of the terrain (4)"),
    "sand": ("PERCENT", "share of sand (mixed: 45)"),
    "dust": ("PERCENT", "share of dust (mixed: 10)"),
    "bedrock": ("PERCENT", "share of bedrock; the rest is gravel (mixed: 15)"),
    "sand_contrast": ("GRAY", "RMS contrast of sand over a few pixels, at mid-gray (2)"),
    "gravel_contrast": ("GRAY", "the same for gravel (gravel: 18; others: 12)"),
    "ripples": ("GRAY", "RMS contrast of sand ripples (1; dunes: 3)"),
    "sun_elevation": ("DEG", "elevation of the sun above the horizon (38; dunes: 30; dusk: 6; bedrock: 45)"),
    "sun_azimuth": ("DEG", "azimuth of the sun, from the world's x axis towards y (140)"),
    "skylight": ("LIGHT", "light from the sky, which fills shadows; the sun's is 0.86 (0.24; dusk: 0.1)"),
    "brightness": ("FACTOR", "exposure; values below 1 darken the images (1; dusk: 0.75)"),
    "noise": ("GRAY", "image noise, one sigma at mid-gray (1.5; dusk: 3; gravel: 1.36)"),
    "blur": ("PX", "lens blur, one sigma (0.55)"),
    "vignetting": ("PERCENT", "light lost at the image corners (14)"),
    "exposure_difference": (
        "PERCENT",
        "extra light in the right image, on top of the 0.5 to 1 %% that the seed adds (0)",
    ),
    "row_offset": ("PX", "rows by which the right image is shifted down (0)"),
    "exposure_time": ("MS", "exposure time, which blurs moving images (0)"),
    "jpeg": ("QUALITY", "write JPEG images of this quality, 1 to 100 (uncompressed images)"),
    "tilt_noise": ("DEG", "inclinometer noise, one sigma (0.1)"),
    "imu": ("KIND", "orientation, or raw for accelerations and rates of a MEMS Imu (orientation)"),
    "vibration": ("M/S2", "vibration of a raw Imu while driving, RMS per axis (0.5)"),
    "rest": ("S", "time at rest before the drive (0)"),
    "pan": ("DEG", "largest pan angle of the camera mast, which swings once in 8 s (0)"),
    "odometry_scale": ("PERCENT", "scale error of odometry (1); 0, with --odometry-turn 0, is exact"),
    "odometry_turn": (
        "DEG",
        "heading drift of odometry after 1 m, one sigma; grows with the square root of distance (0.2)",
    ),
}


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Declare the options."""
    sub.add_argument("out", type=Path, metavar="OUT.mcap", help="the log to write")
    sub.add_argument("--size", type=size, default=(1280, 960), metavar="WxH", help="image size (1280x960)")
    for option, (metavar, text) in OPTIONS.items():
        sub.add_argument(f"--{option.replace('_', '-')}", type=TYPES.get(metavar, float), metavar=metavar, help=text)


def run(options: argparse.Namespace) -> int:
    """Write the traverse."""
    check_outputs({"input log": options.out})
    settings = {
        FIELDS.get(option, option): value * UNITS[metavar] if metavar in UNITS else value
        for option, (metavar, _) in OPTIONS.items()
        if (value := getattr(options, option)) is not None
    }
    width, height = options.size
    try:
        simulate(options.out, **settings, width=width, height=height)
    except UsageError as error:
        raise UsageError(_with_options(str(error))) from None
    return COMPLETE


def _with_options(sentence: str) -> str:
    """The sentence about a field of Simulation, with the name of the option instead."""
    for option in OPTIONS:
        sentence = sentence.replace(f"Simulation.{FIELDS.get(option, option)} ", f"--{option.replace('_', '-')} ")
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
        write_log(simulation, out, lambda done: bar.update(done - bar.n))
    say(f"{out}: {counted(simulation.frames, 'frame')} with ground truth ({out.stat().st_size / 1e6:.1f} MB)")
