"""`roverflow import tartanair`: makes a log from a trajectory of TartanAir or TartanGround."""

from __future__ import annotations

import argparse

from flow.cli.importers.common import add_recording_arguments, import_recording

HELP = "a trajectory of TartanAir or TartanGround"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    add_recording_arguments(
        sub, "folder of a trajectory, such as P000", "height and pitch_down of the camera on base_link"
    )


def run(options: argparse.Namespace) -> int:
    """Write the log."""
    from recordings.importers.rig import LENS, MOUNT
    from recordings.importers.tartanair import read_tartanair

    return import_recording(options, MOUNT + LENS, lambda rig: read_tartanair(options.source, rig))
