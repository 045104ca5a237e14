"""`roverflow import` of data sets whose recordings become logs: one entry of a table each."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

from flow.cli.importers.common import complete, progress_bar
from flow.cli.outputs import check_outputs

FILES: dict[str, Any] = {"type": Path, "nargs": "+", "metavar": "FILE"}


@dataclass(frozen=True)
class DataSet:
    """A kind of recording, which `recordings.importers.KIND.read_KIND` reads.

    HELP: one line, named as in modules of commands; source: what its folder contains; rig: what its rig file says,
    empty if it has none; entries: that the rig file may have, by their names in `recordings.importers.rig`; options:
    further ones, as argparse takes them, in the order in which they are read.
    """

    kind: str
    HELP: str
    source: str
    rig: str
    entries: tuple[str, ...] = ("MOUNT",)
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def add_arguments(self, sub: argparse.ArgumentParser) -> None:
        sub.add_argument("source", type=Path, metavar="SOURCE", help=self.source)
        sub.add_argument("out", type=Path, metavar="OUT.mcap", help="log to write")
        sub.set_defaults(rig=None)
        if self.rig:
            sub.add_argument("--rig", type=Path, metavar="RIG.yaml", help=f"YAML file with missing data: {self.rig}")
        for name, option in self.options.items():
            sub.add_argument(f"--{name}", **option)

    def run(self, options: argparse.Namespace) -> int:
        """Write the log, and print notes, frames and size."""
        from recordings.importers import rig
        from recordings.importers.recording import write_recording

        check_outputs({"input log": options.out}, [path for path in [options.rig] if path is not None])
        described = rig.read_rig(options.rig, sum((getattr(rig, name) for name in self.entries), ()))
        read = getattr(import_module(f"recordings.importers.{self.kind}"), f"read_{self.kind}")
        recording = read(options.source, described, *(getattr(options, name) for name in self.options))
        with progress_bar(options.out, len(recording.pairs)) as shown:
            frames, notes = write_recording(recording, options.out, *shown)
        return complete(options, frames, notes)


DATA_SETS = (
    DataSet(
        "devon",
        "a section of the Devon Island rover navigation data set",
        "folder of a section's rectified images",
        "height and pitch_down of the camera, and the columns of the inclinometer, their unit, signs and tilt_model",
        ("MOUNT", "LENS", "INCLINOMETER"),
        {"logs": {
            "type": Path, "metavar": "DIR",
            "help": "folder with image-times.txt and the other logs (SOURCE/logs, or logs beside SOURCE)",
        }},
    ),
    DataSet(
        "euroc",
        "a sequence in EuRoC's (ASL) layout: EuRoC, TUM-VI and others",
        "folder with mav0",
        "height and pitch_down, and more, of the camera on base_link",
        options={"calibration": FILES | {
            "default": (),
            "help": "calibration instead of cam0/sensor.yaml and cam1/sensor.yaml, such as Kalibr's camchain.yaml",
        }},
    ),
    DataSet(
        "katwijk",
        "a part of a traverse of the Katwijk beach data set (LocCam)",
        "folder of a part, with LocCam and imu.txt",
        "height of the camera, and pitch_down if its mount was changed",
        options={"calibration": FILES | {
            "required": True,
            "help": "LocCam's stereoParams as structs (.mat), or a calibration of OpenCV, Kalibr or ROS",
        }},
    ),
    DataSet(
        "kitti",
        "a raw drive of KITTI, or a sequence of its odometry benchmark",
        "folder of a drive, with the calibration in it or beside it; or of a sequence, with calib.txt",
        "for sequences height and pitch_down of the camera on base_link",
        options={"color": {"action": "store_true", "help": "import the colour cameras instead of the gray ones"}},
    ),
    DataSet(
        "lusnar",
        "a scene of LuSNAR",
        "folder of a scene, with image1, image2 and Rover_pose.txt",
        "height and pitch_down of the camera on base_link, body_axes and world_up of the poses",
        ("MOUNT", "LENS", "AXES"),
    ),
    DataSet(
        "middlebury",
        "a Middlebury scene with ground truth (assumes a level camera 1 m above ground)",
        "folder of a scene",
        "",
    ),
    DataSet(
        "tartanair",
        "a trajectory of TartanAir or TartanGround",
        "folder of a trajectory, such as P000",
        "height and pitch_down of the camera on base_link",
        ("MOUNT", "LENS"),
    ),
)  # fmt: skip
