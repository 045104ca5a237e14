"""The accelerations and rates of a rover that drives over rough ground, with the true direction of up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from recordings.inertial.blocks import InertialSample
from recordings.inertial.up_estimator import UpEstimator

START = 1_700_000_000_000_000_000


@dataclass(frozen=True)
class Drive:
    """n samples. stamps: ns; rates: (n, 3) rad/s; forces: (n, 3) m/s^2; up: (n, 3), true, in the sensor's frame."""

    stamps: np.ndarray
    rates: np.ndarray
    forces: np.ndarray
    up: np.ndarray

    def samples(self):
        """The samples of one sensor."""
        rows = zip(self.stamps.tolist(), self.rates.tolist(), self.forces.tolist(), strict=True)
        return [InertialSample(stamp, tuple(rate), tuple(force)) for stamp, rate, force in rows]

    def errors(self, tilts):
        """The angles, deg, between tilts and the truth."""
        true = self.up[np.searchsorted(self.stamps, [tilt.stamp for tilt in tilts])]
        return np.degrees(np.linalg.norm(np.cross([tilt.up for tilt in tilts], true), axis=1))


def drive(seconds=60, rate=100, seed=1, rest=5.0, gravity=9.81, speed=0.5, gyroscope_bias=0.0035,
          accelerometer_bias=0.0, vibration=0.5, spin=0.0, slope=0.0):  # fmt: skip
    """A drive after some seconds of rest. The biases are standard deviations; noise is that of an Xsens MTi-10.

    spin: rad/s, on the spot in place of rest; slope: deg, of the ground.
    """
    rng = np.random.default_rng(seed)
    times = np.arange(0, seconds, 1 / rate)
    going = np.clip(times - rest, 0, 1)

    def sway():
        found = np.zeros_like(times)
        for low, high, degrees in ((0.05, 0.4, 12.0), (0.5, 3.0, 1.5)):
            for frequency, phase in rng.uniform((low, 0), (high, 2 * np.pi), (5, 2)):
                found += np.radians(degrees / 5) * np.sin(2 * np.pi * frequency * times + phase)
        return found * going

    heading = 0.35 * np.sin(2 * np.pi * np.cumsum(going) / rate * speed / 9)
    heading += spin * np.minimum(times, rest)
    swaying = Rotation.from_euler("ZYX", np.column_stack([heading, sway(), sway()]))
    attitude = Rotation.from_euler("y", slope, degrees=True) * swaying
    turns = (attitude[:-1].inv() * attitude[1:]).as_rotvec() * rate
    rates = np.vstack([turns[:1], turns])
    velocity = attitude.apply([1, 0, 0]) * (speed * going)[:, None]
    place = np.cumsum(velocity, axis=0) / rate + attitude.apply([0.2, 0.1, 0.4])
    acceleration = np.gradient(np.gradient(place, 1 / rate, axis=0), 1 / rate, axis=0)
    forces = attitude.inv().apply(acceleration + np.array([0, 0, gravity]))
    shaken = going[:, None] * rng.normal(size=(2, len(times), 3))
    forces += rng.normal(0, accelerometer_bias, 3) + 8e-4 * np.sqrt(rate) * rng.normal(size=forces.shape)
    rates = rates + rng.normal(0, gyroscope_bias, 3) + 5e-4 * np.sqrt(rate) * rng.normal(size=rates.shape)
    stamps = START + np.round(times * 1e9).astype(np.int64)
    return Drive(stamps, rates + 0.005 * shaken[0], forces + vibration * shaken[1], attitude.inv().apply([0, 0, 1]))


def estimated(samples, **parameters):
    """The tilts of an estimator, and the estimator."""
    estimator = UpEstimator("imu", **{"accelerometer_bias": 0.03, **parameters})
    tilts = [tilt for sample in samples for tilt in estimator.push(sample)]
    return [*tilts, *estimator.finish()], estimator


def errors_of_estimate(simulation, accelerometer_bias=0.03):
    """RMS of the angles, deg, between the estimate and the truth, from the first frame of a simulated drive on; and of
    those about each horizontal axis over their stated sigmas."""
    stamps, found = simulation.sensor_stamps(simulation.imu_rate), simulation.inertial
    up = np.array([simulation.base_at(stamp).after(simulation.mounts[2]).rotation[2] for stamp in stamps])
    driven = Drive(np.array(stamps), found.rates, found.accelerations, up)
    tilts, _ = estimated(driven.samples(), accelerometer_bias=accelerometer_bias)
    tilts = [tilt for tilt in tilts if tilt.stamp >= simulation.start]
    errors = driven.errors(tilts)
    judged = errors / np.sqrt(2) / np.degrees([tilt.sigma for tilt in tilts])
    return tuple(float(np.sqrt(np.mean(values**2))) for values in (errors, judged))
