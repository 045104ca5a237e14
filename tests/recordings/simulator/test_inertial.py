"""A raw Imu of the simulator: its rates and accelerations are those of the drive, with the errors of a sensor."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recordings import McapSource
from recordings.simulator import Simulation, inertial, write_log
from tests.recordings.inertial.drive import rms_of_estimate

DRIVE = Simulation(frames=60, width=64, height=48, imu="raw", relief_cells=512, rest=5.0, slope=float(np.radians(8)))


@pytest.fixture
def flawless(monkeypatch):
    """The drive, with a sensor without errors."""
    for name in ("GYROSCOPE_BIAS", "GYROSCOPE_DENSITY", "ACCELEROMETER_BIAS", "ACCELEROMETER_DENSITY"):
        monkeypatch.setattr(inertial, name, 0.0)
    return replace(DRIVE, vibration=0.0)


def test_the_rates_integrate_to_the_attitude(flawless):
    stamps, mount = flawless.sensor_stamps(flawless.imu_rate), flawless.mounts[2]
    attitudes = [Rotation.from_matrix(flawless.base_at(stamp).after(mount).rotation) for stamp in stamps]
    turned = attitudes[0]
    for before, after in zip(flawless.inertial.rates[:-1], flawless.inertial.rates[1:], strict=True):
        turned = turned * Rotation.from_rotvec((before + after) / 2 / flawless.imu_rate)
    assert (turned.inv() * attitudes[-1]).magnitude() < np.radians(0.1)


def test_the_accelerations_are_those_of_gravity_at_rest_and_on_the_mean(flawless):
    stamps = np.array(flawless.sensor_stamps(flawless.imu_rate))
    up = np.array([flawless.base_at(int(stamp)).after(flawless.mounts[2]).rotation[2] for stamp in stamps])
    off = flawless.inertial.accelerations - inertial.GRAVITY * up
    assert np.abs(off[stamps < flawless.start - 10**9]).max() < 1e-9
    assert np.abs(off[stamps > flawless.start].mean(axis=0)).max() < 0.1
    assert off.std() > 0.1


def test_vibration_and_bumps_leave_no_speed(flawless):
    shaken = replace(flawless, vibration=1.0).inertial.accelerations - flawless.inertial.accelerations
    stamps = np.array(flawless.sensor_stamps(flawless.imu_rate))
    assert np.abs(shaken[stamps < flawless.start - 10**9]).max() == 0
    assert 0.9 < shaken[stamps > flawless.start].std() < 1.3
    assert np.abs(shaken.sum(axis=0) / flawless.imu_rate).max() < 1


def test_a_drive_begins_at_rest_and_its_frames_do_not_depend_on_that():
    without = replace(DRIVE, rest=0.0)
    assert DRIVE.begin == without.begin - 5 * 10**9
    assert DRIVE.distance(DRIVE.begin) == DRIVE.distance(DRIVE.begin + 4 * 10**9) < 0
    assert all(DRIVE.distance(DRIVE.stamp(n)) == without.distance(DRIVE.stamp(n)) for n in range(3))


def test_a_log_has_a_raw_imu_in_place_of_the_inclinometer(tmp_path):
    path = tmp_path / "log.mcap"
    write_log(replace(DRIVE, frames=2), path)
    with McapSource().open(path) as log:
        assert log.missing == {}
        assert log.topics["inclinometer"] == "/imu/data_raw"
        assert "up is estimated from the accelerations and rates on /imu/data_raw" in log.notes()["inclinometer"]


def test_up_is_estimated_to_0_3_degrees():
    drives = [replace(DRIVE, seed=seed, rest=5.0 * (seed % 2)) for seed in range(1, 5)]
    errors = [rms_of_estimate(drive) for drive in drives]
    assert np.sqrt(np.mean(np.square(errors))) < 0.3
