"""`roverflow import kitti`: makes a log from a drive of KITTI."""

from __future__ import annotations

import argparse

from flow.cli.importers.common import add_recording_arguments, import_recording

HELP = "a raw drive of KITTI, or a sequence of its odometry benchmark"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    source = "folder of a drive, with the calibration in it or beside it; or of a sequence, with calib.txt"
    add_recording_arguments(sub, source, "for sequences height and pitch_down of the camera on base_link")
    sub.add_argument("--color", action="store_true", help="import the colour cameras, not the gray ones")


def run(options: argparse.Namespace) -> int:
    """Write the log."""
    from recordings.importers.kitti import read_kitti
    from recordings.importers.rig import MOUNT

    return import_recording(options, MOUNT, lambda rig: read_kitti(options.source, rig, options.color))
