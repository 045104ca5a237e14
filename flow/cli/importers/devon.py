"""`roverflow import devon`: makes a log from a section of the Devon Island rover navigation data set."""

from __future__ import annotations

import argparse
from pathlib import Path

from flow.cli.importers.common import add_recording_arguments, import_recording

HELP = "a section of the Devon Island rover navigation data set"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    rig = "height and pitch_down of the camera, and the columns of the inclinometer, their unit, signs and tilt_model"
    add_recording_arguments(sub, "folder of a section's rectified images", rig)
    logs = "folder with image-times.txt and the other logs (SOURCE/logs, or logs beside SOURCE)"
    sub.add_argument("--logs", type=Path, metavar="DIR", help=logs)


def run(options: argparse.Namespace) -> int:
    """Write the log."""
    from recordings.importers.devon import read_devon
    from recordings.importers.rig import INCLINOMETER, LENS, MOUNT

    return import_recording(
        options, MOUNT + LENS + INCLINOMETER, lambda rig: read_devon(options.source, rig, options.logs)
    )
