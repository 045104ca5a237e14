"""`roverflow import images`: makes a log from a folder of image pairs."""

from __future__ import annotations

import argparse
from pathlib import Path

from flow.cli.importers.common import complete, progress_bar
from flow.cli.outputs import check_outputs

HELP = "a folder of left and right images"


def add_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("source", type=Path, metavar="SOURCE", help="folder of left and right images")
    sub.add_argument("out", type=Path, metavar="OUT.mcap", help="log to write")
    camera = (
        "for rectified pairs a YAML file: fx, cx, cy (px), baseline (m); optionally fy, cx_right, width, height; "
        "for others the files of OpenCV, Kalibr or ROS"
    )
    sub.add_argument("--calibration", type=Path, nargs="+", required=True, metavar="FILE", help=camera)
    pitch = "angle of the camera below the horizon"
    attitude = sub.add_mutually_exclusive_group(required=True)
    attitude.add_argument("--pitch-down", type=float, metavar="DEG", help=pitch)
    each = "attitude of each pair: CSV file with columns name (of the left image) or stamp (ns), pitch_down, roll, yaw"
    attitude.add_argument("--attitudes", type=Path, metavar="FILE", help=each)
    sub.add_argument("--roll", type=float, default=0.0, metavar="DEG", help="camera roll, right side down positive")
    sub.add_argument("--height", type=float, required=True, metavar="M", help="camera height above the ground")
    sub.add_argument("--rate", type=float, default=1.0, metavar="HZ", help="frames per second of the log (1)")


def run(options: argparse.Namespace) -> int:
    """Write the log."""
    from recordings.importers.images import import_images
    from recordings.importers.pairing import pair_images

    found: list[str] = []
    left, right = pair_images(options.source, found)
    files = [*options.calibration, *filter(None, [options.attitudes])]
    check_outputs({"input log": options.out}, [*files, *left, *right])
    given = {name: getattr(options, name) for name in ("roll", "height", "rate", "attitudes")}
    given["pitch_down"] = options.pitch_down or 0.0
    with progress_bar(options.out, len(left)) as shown:
        frames, notes = import_images(
            left, right, options.calibration, options.out, **given, progress=shown[0], report=shown[1]
        )
    return complete(options, frames, [*found, *notes])
