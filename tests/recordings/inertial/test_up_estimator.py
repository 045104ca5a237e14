"""Up from accelerations and rates: as right as its sigma says, from the first sample on, on any planet."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recordings.inertial.blocks import InertialSample
from recordings.inertial.gravity_filter import GYROSCOPE_BIAS_WALK, disturbance
from recordings.inertial.up_estimator import UpEstimator
from stages.data import Tilt
from tests.conftest import data_folder, slow
from tests.recordings.inertial.drive import Drive, drive, estimated


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def judged(driven, tilts):
    """The RMS of the errors about each horizontal axis over their stated sigmas."""
    return rms(driven.errors(tilts) / np.sqrt(2) / np.degrees([tilt.sigma for tilt in tilts]))


@pytest.mark.parametrize(("changes", "largest", "first"), [
    ({}, 0.2, 0.12),
    *slow(
        ({"rest": 0, "gyroscope_bias": 0.05}, 0.5, 0.85),
        ({"rest": 0}, 0.3, 0.55),
        ({"speed": 1.5}, 0.32, 0.12),
        ({"vibration": 2.0}, 0.37, 0.12),
        ({"rate": 400, "accelerometer_bias": 0.03}, 0.35, 0.45),
        ({"gravity": 3.71}, 0.45, 0.14),
        ({"gravity": 1.62}, 0.75, 0.18),
    ),
])  # fmt: skip
def test_up_is_right_at_rest_and_while_driving(changes, largest, first):
    errors, of_sigma = [], []
    for seed in (1, 2, 3):
        driven = drive(seed=seed, **changes)
        tilts, estimator = estimated(driven.samples())
        found = driven.errors(tilts)
        assert tilts[0].stamp == driven.stamps[0]
        assert tilts[-1].stamp > driven.stamps[-1] - 10_000_000
        assert estimator.measured_gravity == pytest.approx(changes.get("gravity", 9.81), rel=0.02)
        errors.append((rms(found), rms(found[: len(found) // 6])))
        of_sigma.append(judged(driven, tilts))
    whole, begin = np.mean(errors, axis=0)
    assert whole < largest
    assert begin < first
    assert 0.2 < rms(of_sigma) < 1.2


@pytest.mark.parametrize(("rate", "taken"), [(5, 1), (10, 1), (100, 20), (100, 10)])
def test_the_sigma_of_slow_samples_contains_the_motion_between_them(rate, taken):
    """Rates are means over the interval before them, or a sample of it."""
    whole = drive(rate=rate, vibration=0.1)
    driven = Drive(*(values[::taken] for values in (whole.stamps, whole.rates, whole.forces, whole.up)))
    tilts, _ = estimated(driven.samples())
    assert 0.2 < judged(driven, tilts) < 1.2


@pytest.mark.parametrize(("spin", "slope"), [(0.2, 0), *slow((0.05, 10), (0.1, 10), (0.2, 10))])
def test_a_steady_turn_on_the_spot_is_no_bias_of_the_gyroscope(spin, slope):
    driven = drive(seconds=30, rest=10.0, spin=spin, slope=slope, vibration=0.1)
    tilts, estimator = estimated(driven.samples())
    assert rms(driven.errors(tilts)) < 0.2
    assert not estimator.contradicts


def test_a_known_gravity_shows_the_bias_along_it():
    driven = drive(rest=60.0)
    driven.forces[:] += [0.0, 0.0, 0.05]
    _, estimator = estimated(driven.samples(), gravity=9.81)
    assert estimator._state.mean[8] == pytest.approx(0.05, abs=0.03)


def test_accelerations_and_rates_may_have_stamps_of_their_own():
    driven = drive(seconds=30, rate=200)
    whole, parts = driven.samples(), []
    for number, sample in enumerate(whole):
        parts.append(InertialSample(sample.stamp, sample.rate, None))
        if number % 3 == 0:
            parts.append(InertialSample(sample.stamp + 1_000_000, None, sample.acceleration))
    one, other = (estimated(samples)[0] for samples in (whole, parts))
    assert [tilt.stamp for tilt in one] == [tilt.stamp for tilt in other]
    assert rms(driven.errors(other)) < 0.2


def test_a_new_estimate_after_a_gap_keeps_the_biases():
    driven = drive(seconds=80)
    samples = driven.samples()
    tilts, _ = estimated(samples[:4000] + samples[4500:])
    assert not any(samples[4000].stamp <= tilt.stamp < samples[4500].stamp for tilt in tilts)
    after = driven.errors(tilts)[4000:]
    assert rms(after) < 0.3


@pytest.mark.parametrize("rest", [5.0, 50.0])
def test_a_gyroscope_may_restart_with_another_bias_in_a_gap(rest):
    driven = drive(seconds=60, rest=rest)
    driven.rates[2500:] += np.radians([1, -1, 1])
    samples = driven.samples()
    tilts, estimator = estimated(samples[:2000] + samples[2500:])
    assert rms(driven.errors(tilts)[2000:]) < 0.3
    assert estimator.rest_seconds > rest - 7


@pytest.mark.parametrize("step", [0.3, 1.0])
def test_a_gyroscope_may_change_its_bias_while_it_drives(step):
    driven = drive(seconds=70)
    driven.rates[4000:] += np.radians([step, -step, step])
    tilts, _ = estimated(driven.samples())
    assert rms(driven.errors(tilts)) < 0.6
    assert judged(driven, tilts) < 1.2


def test_bumps_and_a_short_push_are_no_change_of_the_bias():
    driven = drive(vibration=2.0)
    driven.forces[2000:5500:100] += [5, 0, 40]
    driven.forces[3050:3250] += [1, 0, 0]
    _, estimator = estimated(driven.samples())
    assert np.sqrt(estimator._state.covariance[3, 3]) < 0.001


def test_a_long_gap_leaves_doubt_about_the_gyroscope_and_none_about_a_known_gravity():
    """After an hour the gyroscope's bias has drifted by two standard deviations, and the rover is tilted otherwise."""
    driven, estimator = drive(seconds=120), UpEstimator("imu", 0.03, gravity=9.81)
    before, after = driven.samples()[:6000], driven.samples()[6000:]
    turn, hour = Rotation.from_euler("y", 15, degrees=True), 3_600_000_000_000
    drift = np.array([0.0, 2 * GYROSCOPE_BIAS_WALK * 60, 0.0])
    tilts = [tilt for sample in before for tilt in estimator.push(sample)]
    sure, usual = estimator._state.covariance[8, 8], disturbance(estimator._forces)
    for number, sample in enumerate(after):
        if number % 100 == 0:  # the accelerations before are of another tilt
            assert disturbance(estimator._forces) < 2 * usual
        rate, force = turn.apply([sample.rate, sample.acceleration])
        tilts += estimator.push(InertialSample(sample.stamp + hour, tuple(rate + drift), tuple(force)))
    assert estimator._state.covariance[8, 8] < 1.3 * sure
    late = [tilt for tilt in tilts if tilt.stamp > hour + before[-1].stamp]
    found = [replace(tilt, stamp=tilt.stamp - hour, up=turn.inv().as_matrix() @ tilt.up) for tilt in late]
    assert judged(driven, found) < 1.2


@pytest.mark.parametrize("rates_until", [100, 20])
def test_memory_does_not_grow_with_the_log(rates_until):
    """rates_until: s, after which the gyroscope is silent."""
    estimator, most = UpEstimator("imu", 0.03), 0
    for number, sample in enumerate(drive(seconds=100, rate=50, rest=0).samples()):
        if number > 50 * rates_until:
            sample = replace(sample, rate=None)
        estimator.push(sample)
        waiting = 0 if estimator._blocks is None else len(estimator._blocks.stamps)
        most = max(most, waiting + len(estimator._waiting))
    assert most < 50 * 40


def test_rest_is_found_at_any_rate_of_samples():
    driven = drive(seconds=8, rate=400, rest=6.0)
    assert estimated(driven.samples())[1].rest_seconds > 5


def test_spikes_of_accelerations_do_not_change_the_measured_gravity():
    driven = drive(seconds=20)
    driven.forces[::97] += [0, 0, 160]
    assert estimated(driven.samples())[1].measured_gravity == pytest.approx(9.81, rel=0.02)


def test_samples_without_accelerations_give_no_tilt():
    assert estimated([InertialSample(stamp, (0.0, 0.0, 0.0), None) for stamp in range(0, 10**10, 10**7)])[0] == []


def test_the_error_of_a_filter_is_that_of_its_neighbours():
    tilts = [Tilt(stamp, [np.sin(stamp / 50), 0, np.cos(stamp / 50)], sigma=0.01, filtered=True) for stamp in range(5)]
    between = Tilt.smoothed(tilts, 2)
    assert between.sigma == pytest.approx(0.01)
    np.testing.assert_allclose(between.up, tilts[2].up, atol=1e-12)


def test_up_in_a_frame_of_euroc():
    folder = data_folder("euroc") / "mav0"
    with (folder / "imu0" / "data.csv").open() as file:
        rows = [row for row in csv.reader(file) if row and not row[0].startswith("#")]
    samples = [
        InertialSample(int(row[0]), *(tuple(map(float, row[first : first + 3])) for first in (1, 4))) for row in rows
    ]
    tilts, estimator = estimated(samples)
    numbers = (folder / "cam0" / "sensor.yaml").read_text().split("data: [")[1].split("]")[0].split(",")
    body_from_camera = Rotation.from_matrix(np.array(numbers, float).reshape(4, 4)[:3, :3])
    up = body_from_camera.inv().apply([tilt.up for tilt in tilts])
    expected = np.array([0.036, -0.927, -0.372])
    first = up[[tilt.stamp < tilts[0].stamp + 10**9 for tilt in tilts]]
    assert np.degrees(np.arccos(first @ (expected / np.linalg.norm(expected)))).max() < 1
    assert estimator.measured_gravity == pytest.approx(9.78, abs=0.02)
