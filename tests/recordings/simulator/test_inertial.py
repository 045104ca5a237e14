"""A raw Imu of the simulator: its rates and accelerations are those of the drive, with the errors of a sensor."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recordings import McapSource
from recordings.simulator import Simulation, inertial, write_log
from tests.recordings.inertial.drive import errors_of_estimate

DRIVE = Simulation(frames=12, width=64, height=48, imu="raw", relief_cells=512, rest=5.0, slope=float(np.radians(8)))
STAMPS = np.array(DRIVE.sensor_stamps(DRIVE.imu_rate))


@pytest.fixture(scope="module")
def flawless():
    """The drive without and with vibration, measured by a sensor without errors."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("GYROSCOPE_BIAS", "GYROSCOPE_DENSITY", "ACCELEROMETER_BIAS", "ACCELEROMETER_DENSITY"):
            patch.setattr(inertial, name, 0.0)
        return [replace(DRIVE, vibration=vibration).inertial for vibration in (0.0, 1.0)]


@pytest.fixture(scope="module")
def attitudes():
    """world <- sensor of every sample, (n, 3, 3)."""
    return np.array([DRIVE.base_at(stamp).after(DRIVE.mounts[2]).rotation for stamp in STAMPS.tolist()])


def test_the_rates_integrate_to_the_attitude(flawless, attitudes):
    rates = flawless[0].rates
    turned = Rotation.from_matrix(attitudes[0])
    for turn in Rotation.from_rotvec((rates[:-1] + rates[1:]) / 2 / DRIVE.imu_rate):
        turned = turned * turn
    assert (turned.inv() * Rotation.from_matrix(attitudes[-1])).magnitude() < np.radians(0.1)


def test_the_accelerations_are_those_of_gravity_at_rest_and_on_the_mean(flawless, attitudes):
    off = flawless[0].accelerations - inertial.GRAVITY * attitudes[:, 2]
    assert np.abs(off[DRIVE.start - 10**9 > STAMPS]).max() < 1e-9
    assert np.abs(off[DRIVE.start < STAMPS].mean(axis=0)).max() < 0.1
    assert off.std() > 0.1


def test_vibration_and_bumps_leave_no_speed(flawless):
    shaken = flawless[1].accelerations - flawless[0].accelerations
    assert np.abs(shaken[DRIVE.start - 10**9 > STAMPS]).max() == 0
    assert 0.9 < shaken[DRIVE.start < STAMPS].std() < 1.3
    assert np.abs(shaken.sum(axis=0) / DRIVE.imu_rate).max() < 1


def test_a_drive_begins_at_rest_and_its_frames_do_not_depend_on_that():
    without = replace(DRIVE, rest=0.0)
    assert DRIVE.begin == without.begin - 5 * 10**9
    assert DRIVE.distance(DRIVE.begin) == DRIVE.distance(DRIVE.begin + 4 * 10**9) < 0
    assert all(DRIVE.distance(DRIVE.stamp(n)) == without.distance(DRIVE.stamp(n)) for n in range(3))


def test_a_log_has_a_raw_imu_in_place_of_the_inclinometer(tmp_path):
    path = tmp_path / "log.mcap"
    write_log(replace(DRIVE, frames=2, rest=0.0, map_half_width=1.0), path)
    with McapSource().open(path) as log:
        assert log.missing == {}
        assert log.topics["inclinometer"] == "/imu/data_raw"
        assert "the tilt is estimated from the accelerations and rates on /imu/data_raw" in log.notes()["inclinometer"]


@pytest.mark.slow
@pytest.mark.parametrize("rate", [100.0, 200.0])
def test_up_is_estimated_to_0_3_degrees(rate):
    drives = [replace(DRIVE, frames=60, seed=seed, rest=5.0 * (seed % 2), imu_rate=rate) for seed in range(1, 9)]
    errors, judged = np.sqrt(np.mean(np.square([errors_of_estimate(drive) for drive in drives]), axis=0))
    assert errors < 0.3
    assert 0.4 < judged < 1.2  # of the stated sigma
