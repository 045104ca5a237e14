"""The log of a simulated traverse: the sensors of a rover, and the exact truth under /truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from recordings.mcap.writer import Ros2Writer
from recordings.ros2 import to_msg as ros2
from recordings.simulator import ground_truth, traverse
from recordings.simulator.simulation import MAST_RATE, ODOMETRY_RATE, TILT_RATE, FrameTruth, Simulation
from recordings.source.calibration import pinhole
from stages.data import LEVEL_FRAME

Messages = dict[str, Any]  # by topic

ROCK_FIELDS = ("x", "y", "z", "diameter", "height", "pixels", "shown")


def write_log(simulation: Simulation, out: Path, progress: Callable[[int], object] = lambda done: None) -> None:
    """Write the log of a traverse into an MCAP file; progress: called with the frames written so far after each.

    Examples
    --------
    >>> from pathlib import Path
    >>> from recordings.simulator import Simulation, write_log
    >>> write_log(Simulation(frames=4), Path("traverse.mcap"))  # doctest: +SKIP
    """
    with Ros2Writer(Path(out)) as writer:
        for log_time, make_messages, index in sorted(_moments(simulation), key=lambda moment: moment[0]):
            for topic, message in make_messages().items():
                writer.write(topic, message, log_time)
            if index is not None:
                progress(index + 1)


def _moments(simulation: Simulation) -> Iterator[tuple[int, Callable[[], Messages], int | None]]:
    """(log time, function that makes the messages, frame index or None), unordered."""
    yield simulation.begin, partial(static_transforms, simulation), None
    raw = simulation.imu == "raw"
    tilt = (imu, simulation.imu_rate, 4_000_000) if raw else (inclinometer, TILT_RATE, 4_000_000)
    sensors = [tilt, (odometry, ODOMETRY_RATE, 9_000_000)]
    if simulation.pan:
        sensors.append((mast, MAST_RATE, 6_000_000))
    for make_messages, rate, latency in sensors:
        for number, stamp in enumerate(simulation.sensor_stamps(rate)):
            yield stamp + latency, partial(make_messages, simulation, number, stamp), None
    for index in range(simulation.frames):
        yield simulation.stamp(index) + 21_000_000, partial(frame, simulation, index), index


def static_transforms(simulation: Simulation) -> Messages:
    """/tf_static: the mounts of cameras and inclinometer; those of the cameras are on the mast if it turns."""
    *cameras, sensor = simulation.mounts
    if simulation.pan:
        head = traverse.mast(simulation.camera_height, 0.0).inverse()
        cameras = [head.after(camera) for camera in cameras]
    return {"/tf_static": ros2.transform_message((mount, simulation.begin) for mount in (*cameras, sensor))}


def mast(simulation: Simulation, number: int, stamp: int) -> Messages:
    """/tf: the mast, which turns."""
    head = traverse.mast(simulation.camera_height, simulation.pan_at(stamp))
    return {"/tf": ros2.transform_message([(head, stamp)])}


def inclinometer(simulation: Simulation, number: int, stamp: int) -> Messages:
    """/imu/inclinometer: roll and pitch with noise; the heading is unknown, with the variance of a uniform angle."""
    rng = np.random.default_rng([simulation.seed, 4, number])
    reading = traverse.inclinometer_reading(
        simulation.base_at(stamp), simulation.mounts[2], simulation.tilt_noise, rng
    )  # fmt: skip
    variance = max(simulation.tilt_noise, 1e-6) ** 2
    covariance = np.diag([variance, variance, np.pi**2 / 3])
    return {"/imu/inclinometer": ros2.imu(stamp, traverse.INCLINOMETER_FRAME, reading, covariance)}


def imu(simulation: Simulation, number: int, stamp: int) -> Messages:
    """/imu/data_raw: accelerations and rates, without an orientation."""
    rate, acceleration = simulation.inertial.rates[number], simulation.inertial.accelerations[number]
    return {"/imu/data_raw": ros2.raw_imu(stamp, traverse.INCLINOMETER_FRAME, rate, acceleration)}


def odometry(simulation: Simulation, number: int, stamp: int) -> Messages:
    """/odometry and /tf: dead reckoning since the first message."""
    pose = simulation.odometry[number]
    return {"/odometry": ros2.odometry(pose), "/tf": ros2.transform_message([(pose.transform, stamp)])}


def frame(simulation: Simulation, index: int) -> Messages:
    """Images, calibration and truth of one frame."""
    stamp, truth = simulation.stamp(index), simulation.frame(index)
    return _camera_messages(simulation, stamp, truth) | _truth_messages(simulation, stamp, truth)


def _camera_messages(simulation: Simulation, stamp: int, truth: FrameTruth) -> Messages:
    messages = {}
    name = "image_rect_color" if simulation.color else "image_rect"
    sides = (("left", traverse.LEFT_FRAME), ("right", traverse.RIGHT_FRAME))
    for (side, frame_id), picture in zip(sides, truth.images, strict=True):
        model = pinhole(simulation.camera, side)
        messages[f"/stereo/{side}/camera_info"] = ros2.camera_info(stamp, frame_id, model)
        topic = f"/stereo/{side}/{name}"
        if truth.jpegs is None:
            messages[topic] = ros2.image(stamp, frame_id, picture)
        else:
            content = truth.jpegs[side == "right"]
            messages[f"{topic}/compressed"] = ros2.compressed_image(stamp, frame_id, content, "jpeg")
    return messages


def _truth_messages(simulation: Simulation, stamp: int, truth: FrameTruth) -> Messages:
    elevation, hazards = ground_truth.truth_maps(simulation, stamp, truth)
    rocks = ground_truth.rocks_in_level(simulation, truth)
    level_from_camera = truth.level.rotation.T @ truth.base.after(truth.mounts[0]).rotation
    return {
        "/truth/disparity": ros2.disparity_image(ground_truth.true_disparity(simulation, stamp, truth)),
        "/truth/occlusion": ros2.image(stamp, traverse.LEFT_FRAME, truth.seen),
        "/truth/terrain_class": ros2.image(stamp, traverse.LEFT_FRAME, truth.terrain_class),
        "/truth/elevation_map": ros2.grid_map(elevation),
        "/truth/navigation_map": ros2.occupancy_grid(hazards),
        "/truth/rocks": ros2.float_cloud(stamp, LEVEL_FRAME, ROCK_FIELDS, rocks),
        "/truth/tilt": ros2.quaternion_stamped(level_from_camera, stamp, traverse.LEFT_FRAME),
        "/truth/pose": ros2.exact_odometry(truth.base, stamp),
    }
