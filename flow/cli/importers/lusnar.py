"""`roverflow import lusnar`: makes a log from a scene of LuSNAR."""

from __future__ import annotations

import argparse

from flow.cli.importers.common import add_recording_arguments, import_recording

HELP = "a scene of LuSNAR"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    rig = "height and pitch_down of the camera on base_link, body_axes and world_up of the poses"
    add_recording_arguments(sub, "folder of a scene, with image1, image2 and Rover_pose.txt", rig)


def run(options: argparse.Namespace) -> int:
    """Write the log."""
    from recordings.importers.lusnar import read_lusnar
    from recordings.importers.rig import AXES, LENS, MOUNT

    return import_recording(options, MOUNT + LENS + AXES, lambda rig: read_lusnar(options.source, rig))
