"""`roverflow import euroc`: makes a log from a recording in EuRoC's (ASL) layout."""

from __future__ import annotations

import argparse
from pathlib import Path

from flow.cli.importers.common import add_recording_arguments, import_recording

HELP = "a sequence in EuRoC's (ASL) layout: EuRoC, TUM-VI and others"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    add_recording_arguments(sub, "folder with mav0", "height and pitch_down, and more, of the camera on base_link")
    sub.add_argument(
        "--calibration", type=Path, nargs="+", default=(), metavar="FILE",
        help="calibration instead of cam0/sensor.yaml and cam1/sensor.yaml, such as Kalibr's camchain.yaml",
    )  # fmt: skip


def run(options: argparse.Namespace) -> int:
    """Write the log."""
    from recordings.importers.euroc import read_euroc
    from recordings.importers.rig import MOUNT

    return import_recording(options, MOUNT, lambda rig: read_euroc(options.source, rig, options.calibration))
