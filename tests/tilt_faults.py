"""Faults of an inclinometer, written into a log message by message, and a pipeline that looks for them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stages.data import Array
from tests.conftest import edit_of, rewrite

# The part of the default pipeline that the tilt check, visual odometry and the regional map need.
PIPELINE = """
source: {use: recordings.McapSource}
streams:
  stereo:    {use: flow.align.pair, left: left, right: right, slop: 5 ms}
  tilt:      {use: flow.align.interpolate, stream: inclinometer, at: stereo, smooth: 100 ms}
  logged:    {use: flow.align.interpolate, stream: odometry, at: stereo, max_gap: 1 s}
  mounting:  {use: flow.align.latest, stream: mount, at: stereo}
  matched:   {use: stages.Match, frame: stereo, disparities: 64, max_speckle_size: 100}
  cloud:     {use: stages.Reproject, frame: stereo, disparity: matched}
  motion:    {use: stages.VisualOdometry, frame: stereo, disparity: matched}
  pose:      {use: stages.PoseFilter, motion: motion, tilt: tilt, mount: mounting}
  level:     {use: stages.Level, cloud: cloud, tilt: tilt, mount: mounting}
  region:    {use: stages.Fuse, cloud: level, pose: logged, mount: mounting}
  health:    {use: stages.CheckTilt, motion: motion, tilt: tilt, mount: mounting, cloud: cloud}
sinks:
  - {use: recordings.McapSink, results: [pose]}
"""

Change = Callable[[Array], Array]  # of up (3,) in the inclinometer's frame


def flipped(axis: int) -> Change:
    """The sign of one angle is wrong."""
    return lambda up: up * np.where(np.arange(3) == axis, -1.0, 1.0)


def exchanged(up: Array) -> Array:
    """Pitch is roll, and roll is pitch."""
    return up[[1, 0, 2]]


def degrees_as_radians(up: Array) -> Array:
    """The driver takes degrees for radians."""
    pitch, roll = np.rad2deg(np.arcsin(up[:2]))
    return np.array([np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)])


def radians_as_degrees(up: Array) -> Array:
    """The driver takes radians for degrees."""
    pitch, roll = np.deg2rad(np.arcsin(up[:2]))
    return np.array([np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)])


def changed_ups(log: Path, out: Path, change: Change) -> Path:
    """A copy of the log with every tilt changed."""

    def edit(index: int, message: Any) -> None:
        q = message.orientation
        up = change(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()[2])
        q.x, q.y, q.z, q.w = (float(value) for value in Rotation.align_vectors([[0, 0, 1]], [up])[0].as_quat())

    return rewrite(log, out, edit_of("/imu/inclinometer", "sensor_msgs/msg/Imu", edit))


def turned_mount(log: Path, out: Path, axis: str, degrees: float) -> Path:
    """A copy of the log with the inclinometer rotated about one of its own axes in the static transform."""

    def edit(index: int, message: Any) -> None:
        for transform in message.transforms:
            if transform.child_frame_id == "inclinometer_link":
                q = transform.transform.rotation
                turned = Rotation.from_quat([q.x, q.y, q.z, q.w]) * Rotation.from_euler(axis, degrees, degrees=True)
                q.x, q.y, q.z, q.w = (float(value) for value in turned.as_quat())

    return rewrite(log, out, edit_of("/tf_static", "tf2_msgs/msg/TFMessage", edit))


def late_tilts(log: Path, out: Path, seconds: float) -> Path:
    """A copy of the log with late stamps of the tilts."""

    def edit(index: int, message: Any) -> None:
        stamp = message.header.stamp
        whole = stamp.sec * 10**9 + stamp.nanosec + round(seconds * 1e9)
        stamp.sec, stamp.nanosec = divmod(whole, 10**9)

    return rewrite(log, out, edit_of("/imu/inclinometer", "sensor_msgs/msg/Imu", edit))


FAULTS: dict[str, tuple[Callable[[Path, Path], Path], str]] = {
    "pitch": (lambda log, out: changed_ups(log, out, flipped(0)), "the sign of pitch is flipped"),
    "roll": (lambda log, out: changed_ups(log, out, flipped(1)), "the sign of roll is flipped"),
    "axes": (lambda log, out: changed_ups(log, out, exchanged), "pitch and roll are exchanged"),
    "degrees": (lambda log, out: changed_ups(log, out, degrees_as_radians), "degrees are taken for radians"),
    "radians": (lambda log, out: changed_ups(log, out, radians_as_degrees), "radians are taken for degrees"),
    "mount x": (lambda log, out: turned_mount(log, out, "x", 5.0), "the mount of the inclinometer is wrong by"),
    "mount y": (lambda log, out: turned_mount(log, out, "y", -5.0), "the mount of the inclinometer is wrong by"),
    "mount z": (lambda log, out: turned_mount(log, out, "z", 5.0), "the mount of the inclinometer is wrong by"),
    "late": (lambda log, out: late_tilts(log, out, 0.2), "ms late"),
    "early": (lambda log, out: late_tilts(log, out, -0.2), "ms early"),
}
