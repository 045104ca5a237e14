"""Writes images and raw Imu of a folder in EuRoC's layout as the ROS 1 bag that ASL publishes, with Kalibr's file.

Or as that bag converted to ROS 2, in several files.
"""

import csv
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from rosbags.rosbag2 import StoragePlugin

from recordings.ros2.cdr import standard_types
from recordings.ros2.to_msg import image, raw_imu
from tests.recordings.containers.forms import Row, write_bag, write_rosbag2

LEAD_NS = 2_000_000_000  # of the Imu before the first and after the last image


def euroc_bag(folder: Path, out: Path) -> Path:
    """A bag of the topics /cam0/image_raw, /cam1/image_raw and /imu0; folder: mav0."""
    return write_bag(_rows(folder), out)


def euroc_rosbag2(folder: Path, out: Path) -> Path:
    """The same as a rosbag2 folder of three databases."""
    return write_rosbag2(_rows(folder), out, StoragePlugin.SQLITE3, parts=3)


def _rows(folder: Path) -> list[Row]:
    """Each image and sample, in the order of stamps."""
    images = [
        _row(
            f"/{cam}/image_raw", int(path.stem), image(int(path.stem), cam, cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
        )
        for cam in ("cam0", "cam1")
        for path in (folder / cam / "data").glob("*.png")
    ]
    stamps = [stamp for _, _, stamp, _ in images]
    samples = []
    with (folder / "imu0" / "data.csv").open(newline="") as file:
        for stamp, *values in csv.reader(row for row in file if not row.startswith("#")):
            if min(stamps) - LEAD_NS < int(stamp) < max(stamps) + LEAD_NS:
                sample = raw_imu(int(stamp), "imu4", *np.array(values, float).reshape(2, 3))
                sample.orientation_covariance[0] = 0.0  # as ASL's bags have it
                samples.append(_row("/imu0", int(stamp), sample))
    return sorted([*images, *samples], key=lambda row: row[2])


def _row(topic: str, stamp: int, message: Any) -> Row:
    return topic, message.__msgtype__, stamp, bytes(standard_types().serialize_cdr(message, message.__msgtype__))


def kalibr_camchain(folder: Path, out: Path) -> Path:
    """The calibration of sensor.yaml as Kalibr writes it."""
    cams = {}
    for name in ("cam0", "cam1"):
        text = (folder / name / "sensor.yaml").read_text()
        sensor = yaml.safe_load("\n".join(line for line in text.splitlines() if not line.startswith("%")))
        pose = np.array(sensor["T_BS"]["data"]).reshape(4, 4)
        cams[name] = {
            "T_cam_imu": np.linalg.inv(pose).tolist(), "camera_model": "pinhole", "distortion_model": "radtan",
            "distortion_coeffs": sensor["distortion_coefficients"], "intrinsics": sensor["intrinsics"],
            "resolution": sensor["resolution"], "rostopic": f"/{name}/image_raw",
        }  # fmt: skip
    out.write_text(yaml.safe_dump(cams))
    return out
