"""The sigma of a tilt: as the log states it, or as the readings show it."""

from __future__ import annotations

import numpy as np
import pytest

from recordings.ros2 import to_msg as ros2
from recordings.ros2.tilt_from_msg import tilt_of
from recordings.source.tilt_noise import TiltNoise
from stages.data import Tilt

MS = 1_000_000


def readings(count=400, step=50, noise=0.3, seed=1, swing=5.0, stated=None):
    """Readings of an inclinometer that swings by some degrees every 8 s; step: ms; noise, stated: degrees."""
    rng, made = np.random.default_rng(seed), []
    for number in range(count):
        stamp = number * step * MS + int(rng.integers(0, 2 * MS))
        lean = np.radians(swing) * np.sin(2 * np.pi * stamp / 8e9)
        up = np.array([np.sin(lean), 0.0, np.cos(lean)])
        up[:2] += np.radians(noise) * rng.normal(size=2)
        made.append(Tilt(stamp, up / np.linalg.norm(up), sigma=None if stated is None else np.radians(stated)))
    return made


def shown(tilts):
    noise = TiltNoise()
    return [None if (sigma := noise(tilt).sigma) is None else np.degrees(sigma) for tilt in tilts]


@pytest.mark.parametrize(("step", "noise"), [(10, 0.3), (50, 0.1), (50, 0.3), (200, 0.5)])
def test_the_noise_of_readings_is_found(step, noise):
    found = shown(readings(step=step, noise=noise))
    assert found[:7] == [None] * 7
    assert np.median(found[7:]) == pytest.approx(noise, rel=0.1)
    assert max(found[40:]) < 1.5 * noise


def test_readings_that_are_too_slow_for_the_motion_are_less_sure():
    assert np.median(shown(readings(step=1000, noise=0.1))[7:]) > 0.5


def test_neither_a_wrong_reading_nor_a_gap_changes_the_noise():
    tilts = readings()
    tilts[200] = Tilt(tilts[200].stamp, [np.sin(0.5), 0.0, np.cos(0.5)])
    del tilts[300:340]
    assert max(shown(tilts)[40:]) < 0.5


def test_a_stated_sigma_counts_unless_the_readings_show_a_larger_one():
    assert np.median(shown(readings(stated=0.8))) == pytest.approx(0.8)
    assert np.median(shown(readings(stated=0.01))) == pytest.approx(0.3, rel=0.1)
    assert shown(readings(stated=0.8))[0] == pytest.approx(0.8)


@pytest.mark.parametrize(("variances", "sigma"), [
    ((1e-4, 1e-4, 3.0), 0.01), ((1e-4, 1e-4, 0), 0.01), ((1e-4, 1e-4, 1e-6), 0.01), ((1e-4, 3e-4, 1), np.sqrt(2e-4)),
    ((0.134, 0.134, 0.2), np.sqrt(0.134)), ((9,) * 3, np.pi / 2), ((1e6,) * 3, np.pi / 2), ((0, 0, 0), None),
    ((np.nan, 1, 1), None), ((-2, 4, 1), None),
])  # fmt: skip
def test_the_covariance_of_an_imu_about_the_level_axes_states_the_sigma(variances, sigma):
    message = ros2.imu(5, "imu", np.array([0, 0, 0, 1.0]), np.diag(variances))
    assert tilt_of(message, 5).sigma == (None if sigma is None else pytest.approx(sigma))


def test_interpolated_and_smoothed_tilts_are_surer_than_their_readings():
    up = np.array([0, 0, 1.0])
    tilts = [Tilt(stamp, up, sigma=0.01) for stamp in range(0, 50, 10)]
    assert tilts[0].interpolated(tilts[1], 5).sigma == pytest.approx(0.01 / np.sqrt(2))
    assert tilts[0].interpolated(tilts[1], 0).sigma == pytest.approx(0.01)
    assert Tilt.smoothed(tilts, 20).sigma == pytest.approx(0.01 / np.sqrt(5))
    assert Tilt.smoothed(tilts, 40).sigma > 0.007  # at the end of a line
    assert Tilt.smoothed([*tilts[:4], Tilt(40, up)], 20).sigma is None
