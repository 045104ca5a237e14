"""A raw Imu on the simulated rover: accelerations and rates with the errors of a MEMS sensor, and no orientation.

The errors are those of an Xsens MTi 10-series (MTi User Manual, MT0605P, sensor specifications): typical noise density,
and as one sigma of a bias its repeatability over a year. The biases are drawn once for a log.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stages.data import Array, Transform

GRAVITY = 9.80665  # m/s^2
GYROSCOPE_BIAS = float(np.radians(0.2))  # rad/s
GYROSCOPE_DENSITY = float(np.radians(0.03))  # rad/s/sqrt(Hz)
ACCELEROMETER_BIAS = 0.03  # m/s^2
ACCELEROMETER_DENSITY = 80e-6 * GRAVITY  # m/s^2/sqrt(Hz)
GYROSCOPE_VIBRATION = 0.01  # rad/s for 1 m/s^2 of vibration: a rover that shakes by 5 mm about 0.5 m
BUMPS_PER_METRE, BUMP, BUMP_TIME = 1.0, 2.0, 0.05  # 1/m; m/s^2, one sigma of the peak; s: wheels on small rocks
STEPS = 5  # half-intervals to both sides of a sample, over which accelerations are averaged


@dataclass(frozen=True)
class InertialDrive:
    """The samples of a drive. rates: (n, 3) rad/s; accelerations: (n, 3) m/s^2; both in the sensor's frame."""

    rates: Array
    accelerations: Array


def measured(bodies: list[Transform], mount: Transform, rate: float, vibration: float, speeds: Array,
             rng: np.random.Generator) -> InertialDrive:  # fmt: skip
    """What a sensor measures.

    bodies: world <- base_link at half the intervals of n samples, and `STEPS` of these before the first sample and
    after the last; mount: base_link <- sensor; rate: Hz; vibration: m/s^2, RMS of each axis; speeds: (n,)
    m/s, to the fastest of which it belongs. The acceleration is the mean over a few samples, as a suspension passes it
    on.
    """
    half = 0.5 / rate
    sensors = [body.after(mount) for body in bodies]
    attitudes = Rotation.from_matrix(np.array([sensor.rotation for sensor in sensors]))
    places = np.array([sensor.translation for sensor in sensors])
    at = np.arange(STEPS, len(bodies) - STEPS, 2)
    rates = (attitudes[at - 1].inv() * attitudes[at + 1]).as_rotvec() / (2 * half)
    moved = (places[at + STEPS] - 2 * places[at] + places[at - STEPS]) / (STEPS * half) ** 2
    forces = attitudes[at].inv().apply(moved + np.array([0.0, 0.0, GRAVITY]))
    shaken = vibration * speeds[:, None] / max(float(speeds.max()), 1e-9)
    if vibration:
        forces += _bumps(speeds / rate, rate, rng)
    bandwidth = np.sqrt(rate / 2)
    for values, bias, density, share in (
        (rates, GYROSCOPE_BIAS, GYROSCOPE_DENSITY, GYROSCOPE_VIBRATION),
        (forces, ACCELEROMETER_BIAS, ACCELEROMETER_DENSITY, 1.0),
    ):
        values += rng.normal(0.0, bias, 3)
        values += rng.normal(size=values.shape) * np.hypot(density * bandwidth, share * shaken)
    return InertialDrive(rates, forces)


def _bumps(driven: Array, rate: float, rng: np.random.Generator) -> Array:
    """Accelerations (n, 3), m/s^2, of bumps: up and down again, so that no speed remains. driven: (n,) m a sample."""
    hits = rng.random(len(driven)) < BUMPS_PER_METRE * driven
    peaks = rng.normal(0.0, BUMP, (len(driven), 3)) * hits[:, None]
    time = np.arange(-5 * BUMP_TIME, 5 * BUMP_TIME, 1 / rate) / BUMP_TIME
    shape = -time * np.exp((1 - time**2) / 2)
    return np.stack([np.convolve(peaks[:, axis], shape)[len(shape) // 2 :][: len(driven)] for axis in range(3)], axis=1)
