"""Writes images and raw Imu of a folder in EuRoC's layout as the ROS 1 bag that ASL publishes, with Kalibr's file.

Or as that bag converted to ROS 2, in several files.
"""

import csv
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from rosbags.rosbag1 import Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_typestore

from tests.recordings.containers.forms import write_rosbag2

STORE, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_JAZZY)
LEAD_NS = 2_000_000_000  # of the Imu before the first and after the last image


def euroc_bag(folder: Path, out: Path) -> Path:
    """A bag of the topics /cam0/image_raw, /cam1/image_raw and /imu0; folder: mav0."""
    with Writer(out) as writer:
        connections = {}
        for topic, kind, stamp, message in _messages(folder):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], stamp, STORE.serialize_ros1(message, kind))
    return out


def euroc_rosbag2(folder: Path, out: Path) -> Path:
    """The same as a rosbag2 folder of three databases."""
    rows = [
        (topic, kind, stamp, bytes(ROS2.ros1_to_cdr(STORE.serialize_ros1(message, kind), kind)))
        for topic, kind, stamp, message in _messages(folder)
    ]
    return write_rosbag2(rows, out, StoragePlugin.SQLITE3, parts=3)


def _messages(folder: Path) -> list[tuple[str, str, int, Any]]:
    """Topic, type, stamp and ROS 1 message of each image and sample, in the order of stamps."""
    messages = []
    for cam in ("cam0", "cam1"):
        for path in sorted((folder / cam / "data").glob("*.png")):
            pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            image = _make("sensor_msgs/msg/Image", header=_header(int(path.stem), cam), height=pixels.shape[0],
                          width=pixels.shape[1], encoding="mono8", is_bigendian=0, step=pixels.shape[1],
                          data=pixels.ravel())  # fmt: skip
            messages.append((int(path.stem), f"/{cam}/image_raw", image))
    first, last = min(messages)[0] - LEAD_NS, max(stamp for stamp, _, _ in messages) + LEAD_NS
    with (folder / "imu0" / "data.csv").open(newline="") as file:
        for stamp, *values in csv.reader(row for row in file if not row.startswith("#")):
            if first < int(stamp) < last:
                messages.append((int(stamp), "/imu0", _imu(int(stamp), *np.array(values, float).reshape(2, 3))))
    ordered = sorted(messages, key=lambda each: each[0])
    return [(topic, message.__msgtype__, stamp, message) for stamp, topic, message in ordered]


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


def _imu(stamp, rate, acceleration):
    """As ASL's bags have it: no orientation, and covariances of zeros."""
    vector, nothing = STORE.types["geometry_msgs/msg/Vector3"], np.zeros(9)
    quaternion = STORE.types["geometry_msgs/msg/Quaternion"]
    return _make("sensor_msgs/msg/Imu", header=_header(stamp, "imu4"), orientation=quaternion(0.0, 0.0, 0.0, 0.0),
                 orientation_covariance=nothing, angular_velocity=vector(*rate), angular_velocity_covariance=nothing,
                 linear_acceleration=vector(*acceleration), linear_acceleration_covariance=nothing)  # fmt: skip


def _header(stamp, frame):
    time = STORE.types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
    return STORE.types["std_msgs/msg/Header"](0, time, frame)


def _make(name, **fields):
    return STORE.types[name](**fields)
