"""`roverflow import katwijk`: makes a log from a part of a traverse of the Katwijk beach data set."""

from __future__ import annotations

import argparse
from pathlib import Path

from flow.cli.importers.common import add_recording_arguments, import_recording

HELP = "a part of a traverse of the Katwijk beach data set (LocCam)"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    rig = "height of the camera, and pitch_down if its mount was changed"
    add_recording_arguments(sub, "folder of a part, with LocCam and imu.txt", rig)
    calibration = "LocCam's stereoParams as structs (.mat), or a calibration of OpenCV, Kalibr or ROS"
    sub.add_argument("--calibration", type=Path, nargs="+", required=True, metavar="FILE", help=calibration)


def run(options: argparse.Namespace) -> int:
    """Write the log."""
    from recordings.importers.katwijk import read_katwijk
    from recordings.importers.rig import MOUNT

    return import_recording(options, MOUNT, lambda rig: read_katwijk(options.source, rig, tuple(options.calibration)))
